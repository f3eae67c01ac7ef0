"""The main job: train a policy in Particle Gym under the Director, and evaluate it; see ``python train.py --help``."""

import sys

from deimos.app.cli import main

if __name__ == "__main__":
    sys.exit(main(["train", *sys.argv[1:]]))
