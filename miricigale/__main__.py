"""``python -m miricigale``."""

import sys

from miricigale.cli import main

sys.exit(main())
