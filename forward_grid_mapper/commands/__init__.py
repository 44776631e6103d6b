"""The command lines; each module's `main` is one command."""
