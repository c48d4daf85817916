"""Grade policies: the walking exam, the skill exams and the report."""
