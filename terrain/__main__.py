"""``python -m terrain`` in a checkout, ``python -m deimos.terrain`` everywhere."""

from deimos.terrain.cli import main

if __name__ == "__main__":
    raise SystemExit(main())
