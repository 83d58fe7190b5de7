"""Commands, and what they write."""

from miricigale.cli import main

__all__ = ["command"]


def command(capsys, *arguments, status=0):
    """Run a command that ends with a status; the text and the messages that it writes."""
    capsys.readouterr()
    assert main([str(one) for one in arguments]) == status
    return capsys.readouterr()
