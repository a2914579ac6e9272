"""The test vectors of the contract's README are what our own code writes and reads."""

import re
from pathlib import Path

import numpy as np

from vergence_proto import codec
from vergence_proto.geometry import RectifiedRig
from vergence_proto.types import OutputFormat, StereoRig
from vergence_proto.v1 import depth_pb2 as pb

README = Path(__file__).parents[2] / "proto" / "README.md"
RIG = RectifiedRig(64, 48, 60.0, 60.0, 31.5, 31.5, 23.5, 0.1)


def vectors() -> list[bytes]:
    section = README.read_text("utf-8").partition("### Test vectors")[2].partition("\n## ")[0]
    return [bytes.fromhex(block) for block in re.findall(r"```text\n([0-9a-f\n]+)```", section)]


def test_the_opening_is_what_the_sdk_sends() -> None:
    opening, _ = vectors()
    request = pb.StreamDepthRequest(
        open=pb.OpenStream(
            rig=codec.rig_to_proto(StereoRig.from_rectified(RIG)),
            delivery=pb.DELIVERY_NEWEST,
            output=codec.output_format_to_proto(OutputFormat(denominator=16, deflate=True)),
        )
    )
    assert pb.StreamDepthRequest.FromString(opening) == request
    assert request.SerializeToString(deterministic=True) == opening


def test_the_map_is_read_as_the_page_says() -> None:
    _, answer = vectors()
    message = pb.StreamDepthResponse.FromString(answer).disparity
    rig = RectifiedRig(3, 2, 60.0, 60.0, 1.0, 1.0, 0.5, 0.1)
    disparity = codec.disparity_from_proto(message, rig)
    assert (disparity.frame_id, disparity.capture_ns) == (7, 123456789)
    assert disparity.step_count == 3
    np.testing.assert_array_equal(disparity.disparity_px, [[1.5, 2, np.nan], [1.25, 2.0625, 40]])
