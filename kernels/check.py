"""The check that every launcher makes on its arguments."""

import warp as wp


def require(
    name: str,
    array: wp.array,
    *,
    dtype: type | None = None,
    shape: tuple[int, ...] | None = None,
    like: wp.array | None = None,
) -> None:
    """Raise ``ValueError`` unless ``array`` has the dtype, shape and device asked for.

    Compares on the host and copies nothing.

    Args:
        name: The argument's name, for the message.
        array: The array to check.
        dtype: The dtype it must hold; ``None`` for that of ``like``.
        shape: The shape it must have; ``None`` for that of ``like``, or any shape without ``like``.
        like: An array whose device it must be on, and whose dtype and shape it must have unless given.
    """
    if not isinstance(array, wp.array):
        raise ValueError(f"{name} must be a Warp array, got {type(array).__name__}.")
    device = array.device
    if like is not None:
        dtype = like.dtype if dtype is None else dtype
        shape = like.shape if shape is None else shape
        device = like.device
    shape = array.shape if shape is None else tuple(shape)
    dtype = array.dtype if dtype is None else dtype
    if (array.dtype, array.shape, array.device) != (dtype, shape, device):
        raise ValueError(
            f"{name} must be {dtype.__name__}{shape} on {device}, "
            f"got {array.dtype.__name__}{array.shape} on {array.device}."
        )


def require_axes(name: str, array: wp.array, axes: int) -> None:
    """Raise ``ValueError`` unless ``array`` has that many axes."""
    if array.ndim != axes:
        raise ValueError(f"{name} must have {axes} axes, got the shape {array.shape}.")
