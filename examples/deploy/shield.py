"""A shield at run time: an exported fear network accepts or refuses every goal. Usage: python shield.py FOLDER."""

import json
import sys
from pathlib import Path

import numpy as np
import onnxruntime
import torch

from deimos.goals.shield import Shield

folder = Path(sys.argv[1])  # of `deimos export`, after `deimos shield`
deploy = json.loads((folder / "deploy.json").read_text(encoding="utf-8"))
shield, network = Shield.from_dict(deploy["shield"]), onnxruntime.InferenceSession(folder / "fear.onnx")
state = np.zeros((1, sum(entry["size"] for entry in deploy["fear"]["state"])), np.float32)  # the robot's measurements
active = np.zeros((1, len(deploy["goal"]["components"])), np.float32)  # its current goal
low, high = (np.array([entry[key] for entry in deploy["goal"]["components"]], np.float32) for key in ("low", "high"))
wanted = high[None]  # the next goals


def score(goals: torch.Tensor) -> torch.Tensor:
    """Fear of some goals in this state."""
    inputs = {"state": state, "goal": active, "candidates": goals.numpy()}
    return torch.from_numpy(network.run(["logit"], inputs)[0])


candidates = np.random.default_rng().uniform(low, high, (1, 100, len(low))).astype(np.float32)  # for the mode project
given = shield.choose(score, torch.from_numpy(active), torch.from_numpy(wanted), torch.from_numpy(candidates))
print(f"wanted {wanted[0]}, fear {given.score.item():.2f}, {'refused' if given.refused.item() else 'let through'}")
print(f"pursue {given.goal.numpy()[0]}")
