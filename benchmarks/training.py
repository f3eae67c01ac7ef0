"""How fast training is under every goal selector, compared with Uniform, rsl_rl and the thesis's Table 4.1."""

import contextlib
import io
import math
import statistics
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import torch
from rich.table import Table

from benchmarks import flops
from benchmarks.timing import in_turn, ratio, wide_console
from deimos.goals.methods import method
from deimos.goals.selector import SelectorConfig
from deimos.goals.selectors import vds
from deimos.run.trainer import TrainConfig, Trainer

METHODS_TIMED: dict[str, SelectorConfig] = {
    name: method(name) for name in ("uniform", "p25", "rnd", "learnability", "plr", "grid", "vds", "vds-auxiliary")
} | {"vds, own shares": vds.Config(data="share", epochs=3)}
"""The methods that are timed: one of each kind, and VDS with the cost of each of its options."""
OFTEN = 4  # times as many rounds for methods that differ from Uniform by less than rounds differ from each other


def measure_training(
    config: TrainConfig, methods: Mapping[str, SelectorConfig], thesis: Mapping[str, int], device: torch.device,
    rounds: int, *, length: int | None = None, warm_up: int = 4, beside_rsl_rl: bool = False,
) -> dict[str, Any]:  # fmt: skip
    """Training speed of every method on one environment, alternating iteration by iteration.

    Args:
        config: What to train; its method is ignored.
        methods: Selectors by name, ``uniform`` among them.
        thesis: Thousands of frames per second in the thesis, by name.
        device: Where.
        rounds: Rounds over which ratios are medians.
        length: Iterations of a round; ``None`` for as many as it takes for every world to get at least one goal. 1 is
            enough if goals fall due at a different time in every world.
        warm_up: How often every world gets a goal before anything is timed, so that fear networks see both classes.
        beside_rsl_rl: Whether to time rsl_rl's own loop on the same environment too, if it is installed.
    """
    config = replace(config, method=None, device=str(device))
    period = math.ceil(config.env.goal_period / config.ppo.num_steps)
    length = period if length is None else length
    trainers = {name: Trainer(replace(config, selector=selector), device) for name, selector in methods.items()}

    work: dict[str, Callable[[], Any]] = {name: trainer.iterate for name, trainer in trainers.items()}
    learn = _rsl_rl(config, device) if beside_rsl_rl else None
    if learn is not None:
        work["rsl_rl"] = lambda: learn(1)
    for trainer in trainers.values():
        for _ in range(warm_up * period):
            trainer.iterate()
        trainer.synchronise = True
        trainer.seconds.update(dict.fromkeys(trainer.seconds, 0.0))
    single = in_turn(work, rounds * length, device)
    seconds = {
        name: [math.fsum(values[i : i + length]) for i in range(0, len(values), length)]
        for name, values in single.items()
    }
    transitions = length * config.num_envs * config.ppo.num_steps
    reference = trainers["uniform"]
    learner = flops.of_learner(config.ppo, reference.env)
    rows = []
    for name, values in seconds.items():
        row: dict[str, Any] = {
            "method": name,
            "fps": transitions / statistics.median(values),
            "ms per iteration": 1000 * statistics.median(values) / length,
            "ratio to uniform": 1 / ratio(values, seconds["uniform"]),
            "thesis": thesis[name] / thesis["uniform"] if name in thesis else None,
        }
        if name in trainers:
            spent, extra = trainers[name].seconds, flops.of_selector(methods[name], config.ppo, reference.env)
            row["shares"] = {part: value / sum(spent.values()) for part, value in spent.items()}
            row["extra [GFLOP]"] = extra / 1e9
            row["limit"] = learner / (learner + extra)
        rows.append(row)
    result: dict[str, Any] = {"rows": rows, "learner [GFLOP]": learner / 1e9}
    if "rsl_rl" in seconds:
        result["uniform / rsl_rl"] = ratio(seconds["rsl_rl"], seconds["uniform"])
    return result


def measure_in_groups(
    config: TrainConfig, thesis: Mapping[str, int], device: torch.device, rounds: int, *, everything: bool
) -> dict[str, Any]:
    """``measure_training`` of ``METHODS_TIMED``: the cheap methods in more rounds, VDS separately with Uniform.

    Args:
        config: What to train.
        thesis: Thousands of frames per second in the thesis, by name.
        device: Where.
        rounds: Rounds for VDS; the others get ``OFTEN`` times as many.
        everything: Whether to time all methods and rsl_rl, or only those of the thesis.
    """
    methods = {name: selector for name, selector in METHODS_TIMED.items() if everything or name in thesis}
    dear = {name: selector for name, selector in methods.items() if isinstance(selector, vds.Config)}
    cheap = {name: selector for name, selector in methods.items() if name not in dear}
    result = measure_training(config, cheap, thesis, device, OFTEN * rounds, beside_rsl_rl=everything)
    beside = measure_training(config, {"uniform": cheap["uniform"]} | dear, thesis, device, rounds)
    result["rows"] += [row for row in beside["rows"] if row["method"] in dear]
    return result


def machine(device: torch.device) -> dict[str, float]:
    """The bounds on everything here: large matrix products, and copies of memory by one core."""
    a = torch.randn(2048, 2048, device=device)
    big, copy = (torch.zeros(2**24, device=device) for _ in range(2))
    threads = torch.get_num_threads()
    seconds = min(in_turn({"product": lambda: a @ a}, 5, device)["product"])
    torch.set_num_threads(1)  # Warp's CPU backend runs on one core
    moved = 2 * 4 * 2**24 / min(in_turn({"copy": lambda: copy.copy_(big)}, 5, device)["copy"])
    torch.set_num_threads(threads)
    return {"peak product [GFLOP/s]": 2 * 2048**3 / seconds / 1e9, "copy, one core [GB/s]": moved / 1e9}


def _rsl_rl(config: TrainConfig, device: torch.device) -> Callable[[int], None] | None:
    """rsl_rl's own training loop on the same environment, sizes and hyper-parameters, if it is installed."""
    try:
        from rsl_rl.runners import OnPolicyRunner

        from deimos.adapters.rsl_rl import RslRlVecEnv, runner_config
    except ImportError:
        return None

    env = RslRlVecEnv(config.env.build(config.num_envs, device, config.seed), reward_scale=config.ppo.reward_scale)
    with contextlib.redirect_stdout(io.StringIO()):
        runner = OnPolicyRunner(env, runner_config(config.ppo), log_dir=None, device=str(device))

    def learn(iterations: int) -> None:
        with contextlib.redirect_stdout(io.StringIO()):
            runner.learn(iterations)

    return learn


def print_training(title: str, result: dict[str, Any]) -> None:
    """Print the table of ``measure_training``: ratios are frames per second over Uniform's."""
    rows = result["rows"]
    parts = ("env", "goals", "update", "selector")
    table = Table(title=f"Training, {title}", title_justify="left")
    columns = ("method", "FPS", "ms / iteration", "/ uniform", "FLOP bound", "thesis", *[f"{p} %" for p in parts])
    for name in columns:
        table.add_column(name, justify="left" if name == "method" else "right")
    for row in rows:
        shares = [f"{100 * row['shares'][part]:.1f}" for part in parts] if "shares" in row else ["-"] * len(parts)
        table.add_row(
            row["method"], f"{row['fps']:,.0f}", f"{row['ms per iteration']:.1f}", f"{row['ratio to uniform']:.3f}",
            f"{row['limit']:.3f}" if "limit" in row else "-", f"{row['thesis']:.2f}" if row["thesis"] else "-", *shares,
        )  # fmt: skip
    console = wide_console()
    console.print(table)
    if "uniform / rsl_rl" in result:
        console.print(f"Uniform trains {result['uniform / rsl_rl']:.2f} times as fast as rsl_rl.", highlight=False)
