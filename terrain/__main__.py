"""``python -m terrain`` is ``deimos terrain``."""

import sys

from deimos.app.cli import main

if __name__ == "__main__":
    sys.exit(main(["terrain", *sys.argv[1:]]))
