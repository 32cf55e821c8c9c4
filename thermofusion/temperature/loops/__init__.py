"""The inner loops over observations, compiled: each row is read once, and a vertex's rows stay in the cache."""
