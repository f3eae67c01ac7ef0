"""A picture of a mesh: parallel rays, one for each pixel, and diffuse light."""

import warp as wp

from .check import require, require_axes

wp.set_module_options({"enable_backward": False})


@wp.kernel
def _draw_relief(
    # In
    mesh: wp.uint64,
    corner: wp.vec3,
    right: wp.vec3,
    down: wp.vec3,
    forward: wp.vec3,
    light: wp.vec3,
    # Out
    height: wp.array2d[float],
    brightness: wp.array2d[float],
):
    row, column = wp.tid()
    start = corner + (float(column) + 0.5) * right + (float(row) + 0.5) * down
    hit = wp.mesh_query_ray(mesh, start, forward, 1.0e6)
    if hit.result:
        height[row, column] = start[2] + hit.t * forward[2]
        normal = wp.normalize(hit.normal)
        if wp.dot(normal, forward) > 0.0:  # seen from behind
            normal = -normal
        brightness[row, column] = wp.max(wp.dot(normal, light), 0.0)
    else:
        height[row, column] = wp.nan
        brightness[row, column] = 0.0


def draw_relief(
    mesh: wp.Mesh,
    height: wp.array,
    brightness: wp.array,
    *,
    corner: tuple[float, float, float],
    right: tuple[float, float, float],
    down: tuple[float, float, float],
    forward: tuple[float, float, float],
    light: tuple[float, float, float],
) -> None:
    """Look at a mesh along parallel rays, so that lengths along ``right`` and ``down`` are true to scale.

    Args:
        mesh: Triangles [m].
        height: Height of what each pixel sees [m], NaN where it sees nothing, float32, shape (rows, columns). Written.
        brightness: Cosine between its normal and the light, 0 in its own shade, float32, same shape. Written.
        corner: Where the ray of the upper left corner of the picture starts [m].
        right: From a pixel to the next [m].
        down: From a row of pixels to the next [m].
        forward: Direction of all rays, of length 1.
        light: Direction to the light, of length 1.

    Raises:
        ValueError: If an array has another shape, dtype or device.
    """
    require("mesh.points", mesh.points, dtype=wp.vec3)
    require("height", height, dtype=wp.float32, shape=height.shape, like=mesh.points)
    require_axes("height", height, 2)
    require("brightness", brightness, like=height)
    vectors = [wp.vec3(*vector) for vector in (corner, right, down, forward, light)]
    wp.launch(
        _draw_relief, dim=height.shape, inputs=[mesh.id, *vectors], outputs=[height, brightness], device=height.device
    )
