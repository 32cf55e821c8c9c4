"""Files and folders: safe reading, whole writing, strict documents."""
