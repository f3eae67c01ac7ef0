"""What the thesis measured, for whoever compares with it."""

TABLE_4_1 = {  # thousands of frames per second of training; p25 stands for its Director
    "absolute": {"uniform": 331, "p25": 276, "rnd": 284, "vds": 125},
    "directional": {"uniform": 329, "p25": 274, "rnd": 270, "vds": 119},
    "relative": {"uniform": 332, "p25": 268, "rnd": 272, "vds": 118},
    "quad": {"uniform": 101, "p25": 87, "rnd": 94, "vds": 70, "cl": 101},
    "quad_arm": {"uniform": 78, "p25": 75, "rnd": 70, "vds": 63, "cl": 75},
}
