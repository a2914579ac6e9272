"""Small maps and small images: what was sent comes back where it was, and nothing is invented."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from tests.support.frames import RIG, make_frame
from vergence_proto import codec
from vergence_proto.codec.steps import reduced, widen_bytes, widen_plane
from vergence_proto.errors import BadShape
from vergence_proto.types import (
    DisparityMap,
    ImageEncoding,
    OutputFormat,
    Plane,
    PlaneEncoding,
)
from vergence_proto.v1 import depth_pb2 as pb

SIZES = st.tuples(st.integers(1, 21), st.integers(1, 21))
STEPS = st.sampled_from([2, 4])
VALUES = st.one_of(st.just(np.nan), st.floats(0.25, 64, width=32))


@st.composite
def maps(draw: st.DrawFn) -> tuple[Plane, int, tuple[int, int]]:
    """A plane, its step, and the (width, height) of the whole map."""
    size, step = draw(SIZES), draw(STEPS)
    width, height = reduced(size, step)
    return draw(arrays.arrays(np.float32, (height, width), elements=VALUES)), step, size


@given(maps())
def test_a_value_that_was_sent_is_at_its_own_pixel(
    small: tuple[Plane, int, tuple[int, int]],
) -> None:
    plane, step, size = small
    wide = widen_plane(plane, step, size)
    assert wide.shape == (size[1], size[0])
    np.testing.assert_array_equal(wide[::step, ::step], plane)


@given(maps())
def test_a_pixel_between_has_a_value_between_those_around_it(
    small: tuple[Plane, int, tuple[int, int]],
) -> None:
    plane, step, size = small
    wide = widen_plane(plane, step, size)
    height, width = plane.shape
    for y, x in np.ndindex(wide.shape):
        rows = slice(y // step, min(y // step + 2, height))
        columns = slice(x // step, min(x // step + 2, width))
        around = plane[rows, columns]
        known = around[~np.isnan(around)]
        if np.isnan(wide[y, x]):
            assert len(known) < around.size
        elif known.size == around.size and np.ptp(known) <= step / 2:
            assert known.min() - 1e-4 <= wide[y, x] <= known.max() + 1e-4
        else:  # an edge: one of the values, and none between two surfaces
            assert wide[y, x] in known


def test_a_slope_comes_back_as_it_was() -> None:
    slope = np.add.outer(np.arange(49) / 4, np.arange(65) / 8).astype(np.float32) + 5
    for step in (2, 4):
        wide = widen_plane(slope[::step, ::step].copy(), step, (65, 49))
        np.testing.assert_allclose(wide, slope, atol=1e-4)


def test_bytes_are_not_mixed() -> None:
    plane = np.array([[0, 255], [10, 20]], np.uint8)
    assert set(np.unique(widen_bytes(plane, 4, (7, 6)))) == {0, 255, 10, 20}


@pytest.mark.parametrize("step", [1, 2, 4])
def test_every_plane_of_a_map_is_sent_at_its_step_and_received_whole(step: int) -> None:
    rows, columns = np.mgrid[: RIG.height, : RIG.width].astype(np.float32)
    disparity_map = DisparityMap(
        3,
        9,
        RIG,
        5 + rows / 16 + columns / 32,
        sigma_px=0.5 + columns / 64,
        confidence=(rows * 2).astype(np.uint8),
    )
    output = OutputFormat(
        encoding=PlaneEncoding.FLOAT32, sigma=True, confidence=True, map_step=step
    )
    message = codec.disparity_to_proto(disparity_map, output)
    sent = (message.disparity.width, message.disparity.height)
    assert sent == (RIG.width // step, RIG.height // step)
    received = codec.received_planes_from_proto(message, RIG)
    assert received.step == step
    np.testing.assert_array_equal(received.disparity_px, disparity_map.disparity_px[::step, ::step])
    back = codec.disparity_from_proto(message, RIG)
    assert back.sigma_px is not None
    assert back.confidence is not None
    inside = np.s_[: RIG.height - step, : RIG.width - step]
    np.testing.assert_allclose(
        back.disparity_px[inside], disparity_map.disparity_px[inside], atol=1e-4
    )
    assert back.sigma_px.shape == back.confidence.shape == back.disparity_px.shape
    whole = replace(RIG, width=RIG.width + step)
    with pytest.raises(BadShape, match="expected a disparity plane"):
        codec.disparity_from_proto(message, whole)
    message.map_step = 3
    with pytest.raises(BadShape, match="1, 2 or 4"):
        codec.disparity_from_proto(message, RIG)


@pytest.mark.parametrize("size", [(64, 48), (65, 47)])
def test_images_that_were_sent_at_half_size_are_enlarged(size: tuple[int, int]) -> None:
    ramp = np.linspace(20, 200, size[0]).astype(np.uint8)
    image = np.repeat(np.repeat(ramp[None], size[1], 0)[..., None], 3, 2)
    frame = replace(make_frame(1), left=image, right=image)
    whole = codec.frame_to_request(frame, encoding=ImageEncoding.RAW)
    half = codec.frame_to_request(frame, encoding=ImageEncoding.RAW, scale=2)
    assert len(half) < len(whole) / 3.5
    message = pb.StreamDepthRequest.FromString(half).frame
    assert (message.left.width, message.left.height) == reduced(size, 2)
    back = codec.frame_from_proto(message, size=size)
    assert back.left.shape == image.shape
    assert np.abs(back.left.astype(int) - image).max() <= 4  # a step of the ramp is 3
    message.scale = 1
    with pytest.raises(BadShape, match=f"expected images of {size[0]}x{size[1]}"):
        codec.frame_from_proto(message, size=size)
    message.scale = 4
    with pytest.raises(BadShape, match="a scale of 1 or 2"):
        codec.frame_from_proto(message, size=size)
