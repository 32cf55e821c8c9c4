"""A model that grows while one walks: provisional, so that what is missing is seen before the person has left."""
