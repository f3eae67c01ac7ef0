"""Ready-made studies, by name: the thesis's populations, and one for a small machine."""

from typing import Any

DIRECTORS = ("p10", "p25", "p50", "p75", "p90")
PARTICLE_METHODS = ("coop", *DIRECTORS, "antagonist", "rnd", "uniform", "vds")
LEGGED_METHODS = (*PARTICLE_METHODS, "cl", "vds+p75")


def _particle(variant: str, env_steps: int = 2000, **more: Any) -> dict:
    env = {"kind": "particle", "variant": variant}
    return {"name": variant, "env": env, "train": {"env_steps": env_steps}, **more}


def _legged(name: str, preset: str) -> dict:
    return {"name": name, "preset": preset, "goal_periods": [100, 500]}  # 2 s and 10 s


_ABSOLUTE, _RELATIVE, _DIRECTIONAL = _particle("absolute", 5000), _particle("relative"), _particle("directional")
_METHODS = [*PARTICLE_METHODS, "learnability"]

PRESETS: dict[str, dict] = {
    "absolute": {"about": "Figure 4.5", "seeds": 10, "methods": _METHODS, "environment": [_ABSOLUTE]},
    "relative": {"about": "Figure 4.6", "seeds": 10, "methods": _METHODS, "environment": [_RELATIVE]},
    "directional": {"about": "Figure 4.7", "seeds": 10, "methods": _METHODS, "environment": [_DIRECTIONAL]},
    "particle": {
        "about": "Figures 4.4 to 4.7", "seeds": 10, "methods": _METHODS,
        "environment": [_DIRECTIONAL, _RELATIVE, _ABSOLUTE],
    },
    "quad": {
        "about": "Figures 4.8, 4.9 and A.1; for a cluster", "seeds": 30, "methods": list(LEGGED_METHODS),
        "environment": [_legged("quad", "quad-thesis")],
    },
    "quad_arm": {
        "about": "Figures 4.10, 4.11 and A.2; for a cluster", "seeds": 30, "methods": list(LEGGED_METHODS),
        "environment": [_legged("quad_arm", "quad-arm-thesis")],
    },
    "population": {
        "about": "The populations of docs/particle.md", "seeds": 5, "methods": ["uniform"],
        "environment": [
            _particle("directional", methods=["uniform", "p25", "coop", "antagonist"]), _RELATIVE, _ABSOLUTE,
        ],
    },
    "small": {
        "about": "A look at it all on two cores, in minutes", "seeds": 3,
        "methods": ["coop", "p25", "p75", "antagonist", "uniform"],
        "environment": [_particle("directional")],
        "train": {
            "num_envs": 200,
            "eval": {"worlds": 200, "steps": 1000, "adversary_interactions": 2000, "adversary_crashes": 100},
        },
    },
}  # fmt: skip
"""In the form of a study's TOML file (see ``deimos.study.plan.read``)."""
