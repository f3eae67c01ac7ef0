"""``python -m deimos`` is ``deimos``."""

import sys

from deimos.cli import main

sys.exit(main())
