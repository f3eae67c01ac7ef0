"""A policy and its fear network as ONNX, written from the layers themselves: no tracer, a dynamic batch, one file each.

All that a network needs is in its file: the scale of every observation, the normaliser's statistics, the calibration.
Inputs are in physical units.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor, nn

from deimos.goals.fear_selector import FearSelector
from deimos.learn.policy import Policy
from deimos.nn.normalizer import EPSILON

if TYPE_CHECKING:
    import onnx

OPSET = 17  # old enough for the onnxruntime of 2022, and enough for an MLP
IR_VERSION = 8  # of the file format, which came with that opset
_OPERATORS = {nn.ReLU: "Relu", nn.ELU: "Elu", nn.Tanh: "Tanh"}


class _Graph:
    """Collects the nodes and the constants of a model, one node after another."""

    def __init__(self) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.constants: dict[str, onnx.TensorProto] = {}

    def constant(self, name: str, value: Tensor | np.ndarray | float) -> str:
        """Keep a constant, as float32 unless it is an array of whole numbers; return its name."""
        from onnx import numpy_helper

        array = value.detach().cpu().numpy() if isinstance(value, Tensor) else np.asarray(value)
        array = array if array.dtype == np.int64 else array.astype(np.float32)
        self.constants[name] = numpy_helper.from_array(np.ascontiguousarray(array), name)
        return name

    def add(self, operator: str, *inputs: str, out: str | None = None, **attributes: int) -> str:
        """Add a node; return the name of its output."""
        from onnx import helper

        name = out or f"{operator.lower()}_{len(self.nodes)}"
        self.nodes.append(helper.make_node(operator, inputs, [name], **attributes))
        return name

    def layers(self, x: str, modules: Sequence[nn.Module], name: str, out: str) -> str:
        """Add layers to ``x``, of any number of axes, whose last one holds the inputs."""
        for number, module in enumerate(modules):
            is_last = number == len(modules) - 1
            if isinstance(module, nn.Linear):
                weight = self.constant(f"{name}.{number}.weight", module.weight.T)
                x = self.add("MatMul", x, weight)
                x = self.add(
                    "Add", x, self.constant(f"{name}.{number}.bias", module.bias), out=out if is_last else None
                )
            else:
                x = self.add(_OPERATORS[type(module)], x, out=out if is_last else None)
        return x

    def model(self, name: str, inputs: dict[str, list], outputs: dict[str, list], facts: dict[str, str]) -> bytes:
        """The model in ONNX format, checked; inputs and outputs by name with their shapes."""
        from onnx import TensorProto, checker, helper

        shown = [
            [helper.make_tensor_value_info(key, TensorProto.FLOAT, shape) for key, shape in part.items()]
            for part in (inputs, outputs)
        ]
        graph = helper.make_graph(self.nodes, name, *shown, list(self.constants.values()))
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], producer_name="deimos")
        model.ir_version = IR_VERSION
        helper.set_model_props(model, facts)
        checker.check_model(model, full_check=True)
        return model.SerializeToString()


def policy_model(policy: Policy, facts: dict[str, str]) -> bytes:
    """A policy, from physical observations ``observation`` (batch, n) to mean actions ``action`` (batch, action_dim).

    The n components are those that the actor sees, in the order of ``Policy.layout``.

    Args:
        policy: The policy.
        facts: Texts that are kept in the file's metadata.
    """
    graph, actor = _Graph(), policy.actor
    seen = torch.arange(len(policy.scale))[actor.seen]
    x = graph.add("Mul", "observation", graph.constant("scale", policy.scale.cpu()[seen]))
    if actor.normalizer is not None:
        mean, variance = (part.cpu()[seen] for part in (actor.normalizer.mean, actor.normalizer.variance))
        x = graph.add("Sub", x, graph.constant("mean", mean))
        x = graph.add("Div", x, graph.constant("deviation", variance.sqrt() + EPSILON))
    bounded = np.isfinite(policy.action_bound)
    x = graph.layers(x, list(actor.mean), "actor", "mean_action" if bounded else "action")
    if bounded:
        low, high = graph.constant("low", -policy.action_bound), graph.constant("high", policy.action_bound)
        graph.add("Clip", x, low, high, out="action")
    return graph.model("policy", {"observation": ["batch", len(seen)]}, {"action": ["batch", len(actor.std)]}, facts)


def fear_outputs(afraid: FearSelector) -> tuple[str, ...]:
    """Outputs of the file of a fear network: ``logit``, and ``probability`` where that is calibrated."""
    return ("logit", "probability") if afraid.is_calibrated else ("logit",)


def fear_model(afraid: FearSelector, scale: Tensor, goal_scale: Tensor, facts: dict[str, str]) -> bytes:
    """A fear network: how likely the policy crashes within T steps of getting each of N goals.

    Inputs are ``state`` (batch, state_dim), the active ``goal`` (batch, goal_dim) and ``candidates``
    (batch, N, goal_dim), outputs (batch, N) those of ``fear_outputs``. As in training, the part of the first layer that
    candidates share is computed once.

    Args:
        afraid: The selector that the network belongs to.
        scale: Factors on the components of a state, shape (state_dim,).
        goal_scale: Factors on the components of a goal, shape (goal_dim,).
        facts: Texts that are kept in the file's metadata.
    """
    graph, (first, *others) = _Graph(), list(afraid.fear.network)
    assert isinstance(first, nn.Linear)
    state_dim, goal_dim = len(scale), len(goal_scale)
    if afraid.config.control == "state-blind":
        scale = torch.zeros_like(scale)
    graph.constant("goal_scale", goal_scale)
    state = graph.add("Mul", "state", graph.constant("scale", scale))
    known = graph.add("Concat", state, graph.add("Mul", "goal", "goal_scale"), axis=1)
    weight = first.weight.detach().T
    context = graph.add("MatMul", known, graph.constant("context.weight", weight[: state_dim + goal_dim]))
    context = graph.add("Add", context, graph.constant("context.bias", first.bias))
    context = graph.add("Unsqueeze", context, graph.constant("candidate_axis", np.array([1])))
    shown = graph.add("Mul", "candidates", "goal_scale")
    hidden = graph.add("MatMul", shown, graph.constant("candidates.weight", weight[state_dim + goal_dim :]))
    x = graph.layers(graph.add("Add", hidden, context), others, "fear", "logit_column")
    graph.add("Squeeze", x, graph.constant("last_axis", np.array([2])), out="logit")
    if afraid.is_calibrated:
        calibration = afraid.calibration
        odds = graph.add("Add", "logit", graph.constant("prior", calibration.prior))
        odds = graph.add("Div", odds, graph.constant("temperature", calibration.temperature))
        graph.add("Sigmoid", odds, out="probability")
    inputs = {
        "state": ["batch", state_dim], "goal": ["batch", goal_dim], "candidates": ["batch", "candidates", goal_dim],
    }  # fmt: skip
    outputs = {name: ["batch", "candidates"] for name in fear_outputs(afraid)}
    return graph.model("fear", inputs, outputs, facts)
