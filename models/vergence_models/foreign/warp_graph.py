"""The warp of :mod:`vergence_models.networks.warp` as operators: the last disparity in a new view.

It is the part of ``warp_state`` that decides which surface is seen where: scatter to the nearest
cell, where the nearest surface wins, and close cracks of one cell.
"""

from __future__ import annotations

from onnx import TensorProto

from vergence_models.foreign.graphs import GraphBuilder

# As in vergence_models.networks.warp, which needs torch; a test compares the two.
MIN_DISPARITY_PX = 0.05
_IN_FRONT = 1e-3


def moved_disparity(graph: GraphBuilder, disparity: str, uvd: str, *, scale: int) -> str:
    """Move ``disparity`` [B, 1, h, w] px by ``uvd`` [B, 4, 4]; 0 where nothing is known."""
    shape = graph.add("Shape", disparity)
    one = graph.integers([1])
    d = graph.add("Squeeze", disparity, one)
    cells = graph.add("Shape", d)
    height, width = (graph.dimension(disparity, axis) for axis in (2, 3))
    known = graph.add("Greater", d, graph.floats(MIN_DISPARITY_PX))

    def centres(count: str, axes: list[int]) -> str:
        zero, step = graph.constant(0, "int64"), graph.constant(1, "int64")
        scalar = graph.add("Squeeze", count, graph.integers([0]))
        index = graph.as_float(graph.add("Range", zero, scalar, step))
        full = graph.add("Mul", index, graph.floats(scale))
        full = graph.add("Add", full, graph.floats((scale - 1) / 2))
        return graph.add("Expand", graph.add("Unsqueeze", full, graph.integers(axes)), cells)

    u, v = centres(width, [0, 1]), centres(height, [0, 2])
    ones = graph.add("Add", graph.add("Mul", d, graph.floats(0)), graph.floats(1))
    rows = [graph.add("Unsqueeze", each, one) for each in (u, v, d, ones)]
    flat = graph.integers([0, 4, -1])
    points = graph.add("Reshape", graph.add("Concat", *rows, axis=1), flat)
    moved = graph.add("MatMul", uvd, points)  # [B, 4, h * w]
    x, y, z, w = (graph.add("Gather", moved, graph.constant(i, "int64"), axis=1) for i in range(4))
    in_front = graph.add("Greater", w, graph.floats(_IN_FRONT))
    divisor = graph.add("Max", w, graph.floats(_IN_FRONT))
    u_to, v_to, d_to = (graph.add("Div", each, divisor) for each in (x, y, z))

    def cell_of(position: str) -> str:
        centred = graph.add("Add", position, graph.floats(0.5))
        return graph.add("Floor", graph.add("Div", centred, graph.floats(scale)))

    column, row = cell_of(u_to), cell_of(v_to)
    columns, rows_count = graph.as_float(width), graph.as_float(height)
    flat_known = graph.add("Reshape", known, graph.integers([0, -1]))
    inside = graph.add("And", flat_known, in_front)
    zero = graph.floats(0)
    for position, count in ((column, columns), (row, rows_count)):
        inside = graph.add("And", inside, graph.add("GreaterOrEqual", position, zero))
        inside = graph.add("And", inside, graph.add("Less", position, count))
    near = graph.add("Greater", d_to, graph.floats(MIN_DISPARITY_PX))
    inside = graph.add("And", inside, near)
    place = graph.add("Add", graph.add("Mul", row, columns), column)
    place = graph.add("Cast", graph.add("Where", inside, place, zero), to=TensorProto.INT64)
    value = graph.add("Where", inside, d_to, zero)
    canvas = graph.add("Mul", value, zero)
    landed = graph.add("ScatterElements", canvas, place, value, axis=1, reduction="max")
    return _without_cracks(graph, graph.add("Reshape", landed, shape))


def _without_cracks(graph: GraphBuilder, landed: str) -> str:
    """Give an empty cell the mean of its neighbours if most of them are filled, [B, 1, h, w]."""
    filled = graph.as_float(graph.add("Greater", landed, graph.floats(0)))

    def mean(of: str) -> str:
        window = {"kernel_shape": [3, 3], "pads": [1, 1, 1, 1], "count_include_pad": 1}
        return graph.add("AveragePool", of, **window)

    share = mean(filled)
    around = graph.add("Div", mean(landed), graph.add("Max", share, graph.floats(1e-6)))
    empty = graph.add("Less", filled, graph.floats(0.5))
    crack = graph.add("And", empty, graph.add("Greater", share, graph.floats(0.5)))
    return graph.add("Where", crack, around, landed)
