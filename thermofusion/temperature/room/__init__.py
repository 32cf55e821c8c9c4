"""The room as it was: what surrounds the subject, measured on the background, and what each vertex sees of it."""
