"""What Warp kernels compute in the place of torch's products, where Warp is installed and they fit."""

import sys
from collections.abc import Callable
from importlib.util import find_spec
from typing import Any

import torch
from torch import Tensor, nn

from deimos.nn.networks import Whitening


def fused_scores(
    net: nn.Sequential, goal_dim: int, *, whitening: Whitening | None = None
) -> Callable[[Tensor, Tensor], Tensor] | None:
    """``scores(context, candidates)`` of a network by one kernel, shape (B, N); ``None`` where there is none for it.

    See ``fused.fuse`` for the arguments.
    """
    if not kernels_run_on(next(net.parameters()).device):
        return None
    from deimos.nn.fused import fuse

    return fuse(net, goal_dim, whitening=whitening)


def fused_critics(layers: list[tuple[Tensor, ...]], activation: nn.Module, threads: int) -> Any | None:
    """``values`` and ``gradients`` of an ensemble by kernels; ``None`` where there are none for it.

    See ``fused_critics.fuse_critics`` for the arguments.
    """
    device = layers[0][0].device
    if device.type != "cpu" or not kernels_run_on(device):
        return None
    from deimos.nn.fused_critics import fuse_critics

    return fuse_critics(layers, activation, threads)


def kernels_run_on(device: torch.device) -> bool:
    """Whether Warp is there and, on a GPU, works on the stream that torch works on now.

    Streams are shared by whoever has loaded Warp already; in somebody else's loop on a GPU it is not even imported.
    """
    if device.type == "cpu":
        return find_spec("warp") is not None
    if device.type != "cuda" or "warp" not in sys.modules:
        return False
    import warp as wp

    wp.init()
    theirs = wp.get_stream(f"cuda:{device.index or 0}").cuda_stream
    return (theirs or 0) == torch.cuda.current_stream(device).cuda_stream
