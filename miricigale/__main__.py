"""``python -m miricigale``."""

from miricigale.cli import command

if __name__ == "__main__":
    command()
