"""``python -m deimos`` is ``deimos``."""

import sys

from deimos.app.cli import main

sys.exit(main())
