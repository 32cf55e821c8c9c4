"""Result folders: stored nouns, stages, files written and read again."""
