"""What a state is made of, and that two states are the same."""

import torch


def leaves(state, name=""):
    """All that a state is made of, by name."""
    if isinstance(state, dict | list | tuple):
        for key, value in state.items() if isinstance(state, dict) else enumerate(state):
            yield from leaves(value, f"{name}.{key}")
    else:
        yield name, state


def assert_same(found, expected, name="state"):
    """Two nested states are the same in every part, bit for bit, NaN in the same places."""
    if isinstance(expected, torch.Tensor):
        torch.testing.assert_close(
            found, expected, rtol=0, atol=0, equal_nan=True, msg=lambda text: f"{name}: {text}"
        )  # fmt: skip
    elif isinstance(expected, dict):
        assert found.keys() == expected.keys(), name
        for key in expected:
            assert_same(found[key], expected[key], f"{name}.{key}")
    elif isinstance(expected, list | tuple):
        assert len(found) == len(expected), name
        for i, (one, other) in enumerate(zip(found, expected, strict=True)):
            assert_same(one, other, f"{name}.{i}")
    else:
        assert found == expected or (found != found and expected != expected), f"{name}: {found} is not {expected}"
