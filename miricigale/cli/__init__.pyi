from .program import command as command
from .program import main as main
