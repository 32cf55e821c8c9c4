"""How the subject moved while it was recorded: rigid nodes along its surface, each with a motion over time."""
