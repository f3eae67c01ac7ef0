"""The main job: train a policy in Particle Gym under the Director, and judge it; see ``python train.py --help``."""

import sys

from deimos.app.cli import train

if __name__ == "__main__":
    sys.exit(train())
