"""Grade policies: the walking exam, on rough ground too, the skill exams and the report."""
