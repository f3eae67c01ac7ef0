"""Matrix products by the faster library: it changes no result."""

import copy

import pytest
import torch
from torch import nn

from deimos.nn import matmul as products
from deimos.nn.matmul import add_product_, fast_linear, onednn

CPU = torch.device("cpu")
MATMUL = torch.backends.mkldnn.matmul


@pytest.mark.parametrize("activation", [None, nn.ReLU(), nn.ELU(), nn.Tanh()])
# An outer product, one that MKL makes, one that oneDNN makes.
@pytest.mark.parametrize(("rows", "inputs", "outputs"), [(500, 1, 64), (300, 14, 64), (6000, 64, 64)])
@pytest.mark.parametrize("biased", [False, True])
def test_fast_linear_is_a_linear_layer(activation, rows, inputs, outputs, biased):
    """Whoever multiplies, the result is that of float64 up to the rounding of its sums."""
    torch.manual_seed(0)
    x, weight, bias = torch.randn(rows, inputs), torch.randn(outputs, inputs), torch.randn(outputs) if biased else None
    expected = nn.functional.linear(x.double(), weight.double(), None if bias is None else bias.double())
    expected = expected if activation is None else activation(expected)
    found = fast_linear(x, weight, bias, copy.deepcopy(activation))
    torch.testing.assert_close(found.double(), expected, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize(("rows", "inputs", "outputs"), [(500, 14, 64), (6144, 64, 64), (12000, 11, 64)])
def test_gradients_of_weights_are_float32(rows, inputs, outputs):
    """Sums of thousands of products are off by float32's rounding; that of bfloat16 is a thousand times as large."""
    torch.manual_seed(0)
    delta, x = torch.randn(rows, outputs), torch.randn(rows, inputs)
    total = torch.full((outputs, inputs), 3.0)
    add_product_(total, delta, x)
    expected = 3.0 + delta.double().t() @ x.double()
    assert (total.double() - expected).abs().max() < 2e-5 * rows**0.5


def test_onednn_leaves_the_switch_as_it_was():
    """Afterwards, also after an error and within itself, products are made as before."""
    before = MATMUL.fp32_precision
    inside = "bf16" if products._exact_through_onednn() else before
    with onednn(CPU):
        assert MATMUL.fp32_precision == inside
        with onednn(CPU):
            assert MATMUL.fp32_precision == inside
        assert MATMUL.fp32_precision == inside
    assert MATMUL.fp32_precision == before
    with pytest.raises(KeyError), onednn(CPU):
        raise KeyError
    assert MATMUL.fp32_precision == before


def test_onednn_is_nothing_to_a_gpu(monkeypatch):
    """Products of another device than a CPU neither touch the switch nor try the library."""
    monkeypatch.setattr(products, "_exact_through_onednn", None)
    before = MATMUL.fp32_precision
    with onednn(torch.device("cuda")):
        assert MATMUL.fp32_precision == before


def test_inexact_library_is_not_used(monkeypatch):
    """Where oneDNN would multiply in bfloat16, the switch stays where it is."""
    monkeypatch.setattr(products, "_exact_through_onednn", lambda: False)
    before = MATMUL.fp32_precision
    with onednn(CPU):
        assert MATMUL.fp32_precision == before


@pytest.mark.parametrize("missing", ["none", "operator", "switch"])
def test_private_operators_may_be_missing(monkeypatch, missing):
    """Where PyTorch has no operator of oneDNN, another one, or no switch of precision, its plain products do it."""
    if missing == "operator":
        monkeypatch.setattr(torch.ops.mkldnn, "_linear_pointwise", _refuse)
    if missing == "switch":
        monkeypatch.setattr(products, "_MATMUL", None)
    products._onednn_linear.cache_clear()
    products._exact_through_onednn.cache_clear()
    torch.manual_seed(0)
    x, weight, total = torch.randn(6000, 64), torch.randn(64, 64), torch.zeros(64, 64)
    try:
        assert (products._onednn_linear() is None) == (missing == "operator")
        found = fast_linear(x, weight, None, nn.ReLU())
        add_product_(total, found, x)
    finally:
        products._onednn_linear.cache_clear()
        products._exact_through_onednn.cache_clear()
    expected = nn.functional.linear(x.double(), weight.double()).relu()
    torch.testing.assert_close(found.double(), expected, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(total.double(), expected.t() @ x.double(), rtol=1e-3, atol=1e-2)


def _refuse(*arguments):
    raise RuntimeError("another signature")
