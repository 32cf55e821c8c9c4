"""`python -m thermofusion`."""

from .cli import main

main()
