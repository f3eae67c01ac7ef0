"""Print the table of docs/lab/results.md, pooled over the variants of Particle Gym: ``python docs/pooled_results.py``.

Every policy of docs/results/particle counts, also those whose Adversary is marked weak: one that found nothing to learn
from has met a safe policy.
"""

import csv
from pathlib import Path

import numpy as np

RESULTS = Path(__file__).parent / "results" / "particle" / "results.csv"
RESAMPLES = 10_000


def read() -> dict[str, np.ndarray]:
    """By method: crash rates under Naive and under the Adversary, and the score under Naive beside Uniform's mean.

    Arrays of shape (3, variants, seeds).
    """
    with RESULTS.open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    variants = sorted({row["environment"] for row in rows})

    def values(method: str, goals: str, column: str) -> np.ndarray:
        own = [row for row in rows if (row["method"], row["goals"]) == (method, goals)]
        return np.array([[float(row[column]) for row in own if row["environment"] == name] for name in variants])

    unit = values("uniform", "naive", "score").mean(axis=1, keepdims=True)
    return {
        method: np.stack([
            100 * values(method, "naive", "crash_rate"),
            100 * values(method, "adversary", "crash_rate"),
            values(method, "naive", "score") / unit,
        ])
        for method in sorted({row["method"] for row in rows})
    }  # fmt: skip


def table() -> str:
    """The table, in Markdown: means over variants and policies with 95 % bootstrap intervals, safest first."""
    generator = np.random.default_rng(0)
    lines = []
    for method, values in read().items():
        seeds = generator.integers(values.shape[2], size=(values.shape[1], RESAMPLES, values.shape[2]))
        resampled = np.stack([values[:, i][:, seeds[i]].mean(axis=2) for i in range(values.shape[1])]).mean(axis=0)
        low, high = np.quantile(resampled, [0.025, 0.975], axis=1)
        mean = values.mean(axis=(1, 2))
        digits = (2, 1, 2)
        cells = [f"{m:.{d}f} [{a:.{d}f}, {b:.{d}f}]" for m, a, b, d in zip(mean, low, high, digits, strict=True)]
        lines.append((mean[1], f"| `{method}` | " + " | ".join(cells) + " |"))
    head = "| method | uniform goals that crash [%] | Adversary's goals that crash [%] | score, Uniform = 1 |"
    return "\n".join([head, "|---|---|---|---|", *(line for _, line in sorted(lines))])


if __name__ == "__main__":
    print(table())
