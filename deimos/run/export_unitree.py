"""``deploy.yaml``, as ``unitree_rl_lab`` writes it for the controllers in its folder ``deploy``.

The model is ``source/unitree_rl_lab/unitree_rl_lab/utils/export_deploy_cfg.py`` of that repository, which rounds to
three digits; nothing is rounded here. Its controllers multiply observations by their ``scale`` and then run
a network, but ``policy.onnx`` takes physical ones and scales them itself: so every ``scale`` is 1. Their
``last_action`` is the network's output, ours is what the joints took of it; they differ where a target is beyond a
joint's range.
"""

from pathlib import Path
from typing import Any

UNITREE = (3, 4, 5, 0, 1, 2, 9, 10, 11, 6, 7, 8)
"""Numbers of our leg joints among the motors of Unitree's quadrupeds: front right and left, rear right and left."""
_TERMS = {
    "linear_velocity": "base_lin_vel", "angular_velocity": "base_ang_vel", "gravity": "projected_gravity",
    "goal": "velocity_commands", "joint_position": "joint_pos_rel", "joint_velocity": "joint_vel_rel",
    "last_action": "last_action", "heights": "height_scan",
}  # fmt: skip
"""Isaac Lab's names of the entries of an observation."""


def describe(deploy: dict[str, Any]) -> dict[str, Any]:
    """The contents of ``deploy.yaml``.

    Args:
        deploy: ``deploy.json``, of a legged robot.
    """
    joints = deploy["robot"]["joints"]
    order = [*UNITREE, *range(len(UNITREE), len(joints))]
    motors = sorted(range(len(joints)), key=order.__getitem__)
    pose, scale = ([joint[key] for joint in joints] for key in ("default_position", "action_scale"))
    components = deploy["goal"]["components"][:3]
    ranges = [[component["low"], component["high"]] for component in components]
    return {
        "joint_ids_map": order,
        "step_dt": deploy["control_period"],
        "stiffness": [joints[i]["stiffness"] for i in motors],
        "damping": [joints[i]["damping"] for i in motors],
        "default_joint_pos": pose,
        "commands": {
            "base_velocity": {"ranges": dict(zip(("lin_vel_x", "lin_vel_y", "ang_vel_z"), ranges, strict=True))}
        },
        "actions": {
            "JointPositionAction": {
                "clip": [joint["range"] for joint in joints],  # of the target angles
                "joint_names": [joint["name"] for joint in joints], "scale": scale, "offset": pose, "joint_ids": None,
            },
        },
        "observations": {
            _TERMS.get(entry["name"], entry["name"]): {
                "params": {"command_name": "base_velocity"} if entry["name"] == "goal" else {}, "clip": entry["clip"],
                "scale": [1.0] * entry["size"], "history_length": 1,
            }
            for entry in deploy["observation"]
        },
    }  # fmt: skip


def write(deploy: dict[str, Any], path: Path) -> None:
    """Write ``deploy.yaml``."""
    import yaml

    path.write_text(yaml.safe_dump(describe(deploy), default_flow_style=None, sort_keys=False), encoding="utf-8")
