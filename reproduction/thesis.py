"""The thesis's names and numbers, for comparison."""

DIRECTORS = ("p10", "p25", "p50", "p75", "p90")
DIRECTOR_METHODS = ("coop", *DIRECTORS, "antagonist")
"""By rising fear."""
PARTICLE_METHODS = (*DIRECTOR_METHODS, "rnd", "uniform", "vds")
LEGGED_METHODS = (*PARTICLE_METHODS, "cl", "vds+p75")
PARTICLE = ("absolute", "relative", "directional")
LEGGED = ("quad", "quad_arm")
ENVIRONMENTS = PARTICLE + LEGGED
"""In the thesis's order."""

TABLE_4_1 = {  # thousands of frames per second of training; p25 stands for its Director
    "absolute": {"uniform": 331, "p25": 276, "rnd": 284, "vds": 125},
    "directional": {"uniform": 329, "p25": 274, "rnd": 270, "vds": 119},
    "relative": {"uniform": 332, "p25": 268, "rnd": 272, "vds": 118},
    "quad": {"uniform": 101, "p25": 87, "rnd": 94, "vds": 70, "cl": 101},
    "quad_arm": {"uniform": 78, "p25": 75, "rnd": 70, "vds": 63, "cl": 75},
}
RATIOS_4_1 = {
    place: {name: fps["p25" if name in DIRECTORS else name] / fps["uniform"] for name in (*fps, *DIRECTORS)}
    for place, fps in TABLE_4_1.items()
}
"""Speed relative to Uniform's; p25's is that of every p."""
