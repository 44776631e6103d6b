"""The command lines; the `main` of each module is one command."""
