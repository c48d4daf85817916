"""Grade policies: the walking exam, its rough part, the skill exams and the report."""
