"""Environments on Warp kernels: memory shared with torch, recorded launches, drawing goals."""

import math
from collections.abc import Callable, Sequence
from typing import Any, final

import torch
import warp as wp
from torch import Tensor

from deimos.checks import SimulationError, check_at_least, check_is, check_seed
from deimos.kernels.episodes import RESUMED, WORLDS, Worlds, make_worlds, record, set_goals
from deimos.kernels.goals import draw_candidates
from deimos.kernels.random import Purpose, draw_uniforms
from deimos.kernels.structs import StructTable
from deimos.nn.layout import goal_field
from deimos.sim.env import Env, EnvConfig, ObsField, Step
from deimos.sim.shared import Shared, check_stream, warp_device

MAX_INVALID_SHARE = 1e-3  # of all world-steps; a larger share stops the run
GUARD = 64  # rows behind the observations, which catch what a kernel writes beyond the last one
WINDOW = 10_000  # world-steps, at least, that the share is taken of, however often it is checked
AS_ON_GPU = False
"""Whether a CPU is treated as a device that the host has to wait for, as it has for a GPU: for tests."""


class WarpEnv(Env):
    """An environment on Warp kernels.

    A subclass calls this constructor, allocates its own state with ``allocate``, and finally calls ``begin`` with a
    kernel for the step (physics, reward, crash, observation) and one for the reset; see ``deimos.kernels.episodes`` for
    what these share, and docs/add_an_environment.md for a complete example. Masks, worlds, goals and shares whose
    shape, dtype or device is not as ``Env`` says raise a ``ValueError``: nothing is broadcast or converted. So do, on a
    CPU, worlds that do not exist or are given two goals at once; on a GPU the check would make the host wait.

    Args:
        config: The task.
        num_envs, device, seed, env_offset: See ``EnvConfig.build``.
        layout: Fields of the observation, in order. Goals are shown times the scale of the field ``goal``.
        goal_range: Half side of the box that goals are drawn from along every component, in physical units.
        action_dim: Components of an action.
        action_bound: The environment clips actions to [-action_bound, action_bound].
        dt: Duration of a step [s]; 1 where the environment has no seconds.
        time_limit: Steps after which an episode is truncated; 0 for never.
        stagger: Whether the goal clock of every world's first episode starts at a random step.

    Raises:
        ValueError: If ``num_envs`` or ``seed`` is out of its range, or goals and their field differ in size.
    """

    quantities: tuple[str, ...] = ("action",)
    """What may be broken in an invalid world, by the bits of the cause that the step's kernel gives ``end_step``."""
    worlds: Worlds
    """The arrays that all environments have for their worlds, for the kernels."""
    action: Shared
    """The actions of the step: ``worlds.action``."""
    goal_range: Tensor
    """See ``Env.goal_range``."""
    beyond_obs: Tensor
    """Memory behind ``obs`` that no kernel may write to, for ``check_env``."""
    launch_step: Callable[[], None]
    """Simulates one step with the actions in ``action``; also for benchmarks."""

    def __init__(
        self, config: EnvConfig, num_envs: int, device: torch.device, seed: int, env_offset: int, *,
        layout: Sequence[ObsField], goal_range: Sequence[float], action_dim: int, action_bound: float = math.inf,
        dt: float = 1.0, time_limit: int = 0, stagger: bool = False,
    ) -> None:  # fmt: skip
        check_stream(device)
        check_at_least("num_envs", num_envs, 1)
        check_seed(seed)
        self.config = config
        self.num_envs, self.device = num_envs, device
        self._seed, self._offset = seed, env_offset
        self.layout, self.action_dim, self.action_bound = tuple(layout), action_dim, action_bound
        self.dt, self.goal_period, self.time_limit = dt, config.goal_period, time_limit
        self.crash_penalty = config.crash_penalty * config.largest_reward
        goal = self.goal_slice
        scale = goal_field(self.layout).scale
        scales = scale if isinstance(scale, tuple) else (scale,) * self.goal_dim
        for name, numbers in (("goal_range", goal_range), ("scale of the goal", scales)):
            if len(numbers) != self.goal_dim:
                raise ValueError(f"{name} must have {self.goal_dim} components, got {len(numbers)}.")
        groups = len(self.goal_groups)
        self.worlds = make_worlds(
            num_envs, warp_device(device), obs_dim=self.obs_dim, action_dim=action_dim, goal_start=goal.start,
            goal_scale=scales, goal_period=config.goal_period, time_limit=time_limit, stagger=stagger, seed=seed,
            world_offset=env_offset, crash_penalty=self.crash_penalty, num_groups=groups if groups > 1 else 0,
        )  # fmt: skip
        guarded = wp.zeros((num_envs + GUARD, self.obs_dim), wp.float32, device=warp_device(device))
        self.worlds.obs = guarded[:num_envs]
        self.beyond_obs = wp.to_torch(guarded)[num_envs:]
        views = {name: wp.to_torch(getattr(self.worlds, name)) for name in WORLDS.names}
        self._views = views
        self._memory = [views[name] for name in (*Step.__dataclass_fields__, *RESUMED)]
        # Observations are stored, not recomputed: what a policy saw is part of a bit-exact resume.
        self.tensors = {name: views[name] for name in RESUMED}
        step = {name: views[name] for name in Step.__dataclass_fields__}
        self._step = Step(**step | {"tracking": views["tracking"] if groups > 1 else None})
        self.obs, self.episode_step = views["obs"], views["episode_step"]
        self.action = Shared(self.worlds.action, views["action"])
        self.goal_range = torch.tensor(goal_range, dtype=torch.float32, device=device)
        seen = [half_side * scale for half_side, scale in zip(goal_range, scales, strict=True)]
        self._seen_range = torch.tensor(seen, dtype=torch.float32, device=device)
        self._row = Shared.zeros(num_envs, wp.int32, device)
        self._draw = Shared.zeros(num_envs, wp.vec4, device)
        self._new_goal = Shared.zeros((num_envs, self.goal_dim), wp.float32, device)
        self._candidate_scale = Shared.zeros(self.goal_dim, wp.float32, device)
        self._first_range = _Share(self.goal_range, views["first_range"])
        self._candidate_range = _Share(self._seen_range, self._candidate_scale.tensor)
        self._nobody = torch.full((num_envs,), -1, dtype=torch.int64, device=device)
        self._candidates: dict[int, tuple[Shared, list[wp.Launch]]] = {}
        self.invalid_steps = 0
        """Number of invalid world-steps that ``check`` has found."""
        self._no_fault = views["fault"].clone()
        self._window_began = self._faults_known = 0

    @final
    def allocate(self, table: StructTable, *, resume: bool = True, **sizes: int) -> Any:
        """Allocate a struct of arrays, all zeros.

        Args:
            table: The struct and the shapes of its arrays, of which ``num_envs`` is known.
            resume: Whether a bit-exact resume needs them; their first axis must then be the worlds.
            sizes: The other sizes in the table.

        Returns:
            The struct, for the kernels; torch sees its arrays as ``tensors``.
        """
        struct = table.allocate(warp_device(self.device), num_envs=self.num_envs, **sizes)
        views = {name: wp.to_torch(getattr(struct, name)) for name in table.names}
        if taken := sorted(self.tensors.keys() & views.keys()):
            raise ValueError(f"{table.struct.key} must not hold {', '.join(taken)}: every environment has its own.")
        self._memory += views.values()
        if resume:
            self.tensors |= views
        return struct

    @final
    def record(self, kernel: wp.Kernel, *inputs: object) -> Callable[[], None]:
        """Record a kernel over all worlds, with the arguments ``worlds`` and ``inputs``.

        Replaying a launch costs half of making it (18 us against 34 us on a CPU).
        """
        return record(kernel, self.worlds, *inputs).launch

    @final
    def begin(
        self, step: Callable[[], None], reset: Callable[[], None], *,
        valid_goals: Callable[[wp.array], wp.Launch] | None = None,
    ) -> None:  # fmt: skip
        """Begin every world's first episode: the last thing that a constructor does.

        Args:
            step: Simulates one step with the actions in ``action``.
            reset: Begins an episode in the worlds of ``worlds.mask``.
            valid_goals: Records a launch with two axes, rows first, that turns candidates into valid goals. It takes
                candidates as the policy sees them, uniform in their box for the worlds of ``_row``, float32, shape
                (num_envs, count, goal_dim). ``None`` if all are valid.
        """
        self.launch_step, self._launch_reset, self._valid_goals = step, reset, valid_goals
        self._launch_goals = set_goals(self._row.array, self._new_goal.array, self.worlds)
        self._launch_draw: wp.Launch = draw_uniforms(
            self._row.array, self.worlds.goal_count, self._draw.array, seed=self._seed, purpose=Purpose.GOAL,
            world_offset=self._offset, record=True,
        )  # fmt: skip
        for tensor in self._memory:
            tensor.zero_()  # undo the effects of recording
        self._clear_faults()
        self.reset(torch.ones(self.num_envs, dtype=torch.bool, device=self.device))

    @final
    def step(self, action: Tensor) -> Step:
        """See ``Env.step``."""
        _require_shape("action", action, self.action.tensor.shape)
        check_stream(self.device)
        self.action.tensor.copy_(action.detach())
        self.launch_step()
        self.steps += 1
        return self._step

    @final
    def reset(self, mask: Tensor, goal_scale: Tensor | None = None) -> None:
        """See ``Env.reset``."""
        check_stream(self.device)
        _require("mask", mask, self._views["mask"].shape, self._views["mask"])
        self._views["mask"].copy_(mask)
        self._first_range.set(goal_scale)
        self._launch_reset()

    @final
    def sample_goals(self, rows: Tensor, count: int, scale: Tensor | None = None) -> Tensor:
        """See ``Env.sample_goals``."""
        check_stream(self.device)
        if count not in self._candidates:
            self._candidates[count] = self._record_candidates(count)
        candidates, launches = self._candidates[count]
        self._set_rows(rows)
        self._candidate_range.set(scale)
        for launch in launches:
            launch.set_dim((len(rows), launch.bounds.shape[1]))  # as many threads per row as were recorded
            launch.launch()
        return candidates.tensor[: len(rows)]

    @final
    def goal_bounds(self, rows: Tensor) -> tuple[Tensor, Tensor] | None:
        """See ``Env.goal_bounds``."""
        if self._valid_goals is not None:
            return None
        middle = torch.zeros(len(rows), self.goal_dim, dtype=torch.float32, device=self.device)
        if self.worlds.origin.shape[0]:
            middle -= wp.to_torch(self.worlds.origin)[rows] * (self._seen_range / self.goal_range)
        return middle - self._seen_range, middle + self._seen_range

    @final
    def seen_goals(self) -> Tensor:
        """What the goal's slot of every world's observation must hold, shape (num_envs, goal_dim)."""
        goal = self._views["goal"]
        if self.worlds.origin.shape[0]:
            goal = goal - wp.to_torch(self.worlds.origin)
        return goal * self._views["goal_scale"]

    @final
    def draw(self, rows: Tensor) -> Tensor:
        """See ``Env.draw``."""
        check_stream(self.device)
        self._set_rows(rows)
        self._launch_draw.set_dim(len(rows))
        self._launch_draw.launch()
        return self._draw.tensor[: len(rows)]

    @final
    def set_goals(self, rows: Tensor, goal: Tensor, where: Tensor | None = None) -> None:
        """See ``Env.set_goals``."""
        check_stream(self.device)
        self._require_rows(rows)
        if self._may_read and len(rows) and (times := rows.bincount()).max() > 1:
            raise ValueError(f"rows must be different worlds, got {int(times.argmax())} more than once.")
        _require("goal", goal, (len(rows), self.goal_dim), self._new_goal.tensor)
        if where is not None:
            _require("where", where, rows.shape, self._views["mask"])
            rows = torch.where(where, rows, self._nobody[: len(rows)])
        self._row.tensor[: len(rows)] = rows
        self._new_goal.tensor[: len(rows)] = goal.detach()
        self._launch_goals.set_dim(len(rows))
        self._launch_goals.launch()

    def take_worlds(self, state: dict[str, Tensor]) -> None:
        """See ``Env.take_worlds``. Clocks of goals that lasted longer there are taken modulo this T.

        So goals that fell due evenly continue to do so, instead of most of them at the first step.
        """
        super().take_worlds(state)
        self.tensors["goal_clock"].remainder_(self.goal_period)

    @final
    def check(self) -> None:
        """See ``Env.check``. An action that is not finite stops the run at once.

        So does any invalid world, unless ``may_go_on_invalid``. In that case single ones are reset and left out of
        learning, and too many stop the run: more than a share of the world-steps since the window began. A window ends
        with the first check after at least ``WINDOW`` of them.
        """
        faults, world, actor = self._views["fault"].tolist()
        self.invalid_steps += faults - self._faults_known
        self._faults_known = faults
        window = (self.steps - self._window_began) * self.num_envs
        message = None
        if actor < self.num_envs:
            message = f"World {actor}: its action is not finite."
        elif faults > (MAX_INVALID_SHARE * max(window, WINDOW) if self.may_go_on_invalid else 0):
            message = (
                f"World {world}: {self.describe_fault(world)}; {faults} of the last {window} world-steps were invalid"
            )
            too_many = f", more than {100 * MAX_INVALID_SHARE:g} % of {max(window, WINDOW)}."
            message += too_many if self.may_go_on_invalid else "."
        if message or window >= WINDOW:
            self._clear_faults()
        if message:
            raise SimulationError(message)

    def describe_fault(self, world: int) -> str:
        """What was wrong with a world when it was last invalid."""
        cause = int(self._views["cause"][world])
        broken = " and ".join(name for bit, name in enumerate(self.quantities) if cause & 1 << bit)
        return f"its {broken or 'state'} is not finite"

    def _clear_faults(self) -> None:
        """Begin a new window."""
        self._views["fault"].copy_(self._no_fault)
        self._window_began, self._faults_known = self.steps, 0

    def _record_candidates(self, count: int) -> tuple[Shared, list[wp.Launch]]:
        check_at_least("count", count, 1)
        candidates = Shared.zeros((self.num_envs, count, self.goal_dim), wp.float32, self.device)
        scale = self._candidate_scale.array
        launches = [draw_candidates(self._row.array, scale, candidates.array, self.worlds)]
        if self._valid_goals:
            launches.append(self._valid_goals(candidates.array))
        return candidates, launches

    @property
    def _may_read(self) -> bool:
        """Whether the host reads numbers of the device without waiting for it."""
        return self.device.type == "cpu" and not AS_ON_GPU

    def _set_rows(self, rows: Tensor) -> None:
        self._require_rows(rows)
        self._row.tensor[: len(rows)] = rows

    def _require_rows(self, rows: Tensor) -> None:
        """Raise ``ValueError`` unless these are worlds of this environment: a kernel would write beyond its memory."""
        check_is("rows", rows, Tensor)
        if rows.dtype not in (torch.int32, torch.int64):  # a mask would be read as worlds 0 and 1
            raise ValueError(f"rows must be whole numbers of worlds, got {rows.dtype}.")
        if rows.dim() != 1 or len(rows) > self.num_envs:
            most = f"(B,), at most {self.num_envs} worlds"
            raise ValueError(f"rows must have the shape {most}, got {tuple(rows.shape)}.")
        _require_device("rows", rows, self._row.tensor.device)
        if self._may_read and len(rows):
            lowest, highest = map(int, rows.aminmax())
            if lowest < 0 or highest >= self.num_envs:
                wrong = lowest if lowest < 0 else highest
                raise ValueError(f"rows must be worlds in [0, {self.num_envs}), got {wrong}.")


class _Share:
    """A share of a range, in memory that a kernel reads; the whole range is written only after another share."""

    def __init__(self, whole: Tensor, out: Tensor) -> None:
        self._whole, self._out = whole, out
        self._is_whole = False

    def set(self, share: Tensor | None) -> None:
        """Write ``share`` of the range, of the shape of the range, in (0, 1]; ``None`` for the whole."""
        if share is not None:
            _require("share of the goal range", share, self._whole.shape, self._whole)
            torch.mul(self._whole, share.detach(), out=self._out)
        elif not self._is_whole:
            self._out.copy_(self._whole)
        self._is_whole = share is None


def _require_shape(name: str, tensor: Tensor, shape: tuple[int, ...]) -> None:
    """Raise ``ValueError`` for another shape: nothing is broadcast, which would hide a mistake."""
    if tensor.shape != shape:
        raise ValueError(f"{name} must have the shape {tuple(shape)}, got {tuple(tensor.shape)}.")


def _require_device(name: str, tensor: Tensor, device: torch.device) -> None:
    """Raise ``ValueError`` for another device: a copy would be waited for in every step."""
    if tensor.device != device:
        raise ValueError(f"{name} must be on {device}, got it on {tensor.device}; move it there with .to(env.device).")


def _require(name: str, tensor: Tensor, shape: tuple[int, ...], like: Tensor) -> None:
    """Raise ``ValueError`` unless a tensor has this shape, and the dtype and the device of ``like``.

    So no list of worlds passes for a mask.
    """
    check_is(name, tensor, Tensor)
    _require_shape(name, tensor, shape)
    if tensor.dtype != like.dtype:
        way_out = "; convert it with .float()" if like.is_floating_point() else ""
        raise ValueError(f"{name} must be {str(like.dtype).removeprefix('torch.')}, got {tensor.dtype}{way_out}.")
    _require_device(name, tensor, like.device)
