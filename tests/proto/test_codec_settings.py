"""A stream's settings travel whole, and errors keep their class."""

from types import ModuleType

import pytest
from google.rpc import error_details_pb2
from hypothesis import given
from hypothesis import strategies as st

from vergence_proto import codec
from vergence_proto.codec import enums
from vergence_proto.errors import ERROR_CLASSES, BadPose, BadShape, DepthError, ErrorCode
from vergence_proto.geometry import Axes
from vergence_proto.types import Delivery, Origin, OutputFormat, PlaneEncoding
from vergence_proto.v1 import depth_pb2 as pb


class TestSettings:
    @given(
        st.sampled_from(PlaneEncoding),
        st.integers(4, 64),
        st.booleans(),
        st.booleans(),
        st.booleans(),
        st.sampled_from([1, 2, 4]),
        st.booleans(),
    )
    def test_output_round_trip(
        self,
        encoding: PlaneEncoding,
        denominator: int,
        compressed: bool,
        confidence: bool,
        sigma: bool,
        map_step: int,
        deflate: bool,
    ) -> None:
        deflate = deflate and compressed
        output = OutputFormat(
            encoding, denominator, compressed, confidence, sigma, map_step, deflate=deflate
        )
        assert codec.output_format_from_proto(codec.output_format_to_proto(output)) == output

    def test_an_empty_format_is_the_default(self) -> None:
        exact = codec.output_format_from_proto(pb.OutputFormat())
        assert exact == OutputFormat().resolved()
        assert (exact.denominator, exact.map_step) == (64, 1)

    @pytest.mark.parametrize("map_step", [3, 8])
    def test_a_map_step_out_of_range_is_refused_on_both_sides(self, map_step: int) -> None:
        with pytest.raises(BadShape, match="1, 2 or 4"):
            codec.output_format_from_proto(pb.OutputFormat(map_step=map_step))
        with pytest.raises(BadShape, match="1, 2 or 4"):
            codec.output_format_to_proto(OutputFormat(map_step=map_step))

    @pytest.mark.parametrize("denominator", [1, 3, 65, 1000])
    def test_a_denominator_out_of_range_is_refused_on_both_sides(self, denominator: int) -> None:
        with pytest.raises(BadShape, match="4 to 64"):
            codec.output_format_from_proto(pb.OutputFormat(denominator=denominator))
        with pytest.raises(BadShape, match="4 to 64"):
            codec.output_format_to_proto(OutputFormat(denominator=denominator))

    @pytest.mark.parametrize("encoding", [pb.PLANE_ENCODING_UINT8, 99])
    def test_disparity_is_not_sent_in_bytes_or_the_unknown(
        self, encoding: pb.PlaneEncoding
    ) -> None:
        with pytest.raises(BadShape, match="output encoding"):
            codec.output_format_from_proto(pb.OutputFormat(encoding=encoding))

    def test_unspecified_means_the_documented_default(self) -> None:
        assert codec.axes_from_proto(pb.AXES_UNSPECIFIED) is Axes.OPENCV
        assert codec.delivery_from_proto(pb.DELIVERY_UNSPECIFIED) is Delivery.NEWEST

    @pytest.mark.parametrize("axes", Axes)
    def test_axes_round_trip(self, axes: Axes) -> None:
        assert codec.axes_from_proto(codec.axes_to_proto(axes)) is axes

    @pytest.mark.parametrize("delivery", Delivery)
    def test_delivery_round_trip(self, delivery: Delivery) -> None:
        assert codec.delivery_from_proto(codec.delivery_to_proto(delivery)) is delivery

    @pytest.mark.parametrize("origin", Origin)
    def test_origin_round_trip(self, origin: Origin) -> None:
        assert codec.origin_from_proto(codec.origin_to_proto(origin)) is origin

    @pytest.mark.parametrize(
        ("table", "wire"),
        [
            pytest.param(enums.AXES, pb.Axes, id="axes"),
            pytest.param(enums.DISTORTION, pb.Distortion, id="distortion"),
            pytest.param(enums.DELIVERY, pb.Delivery, id="delivery"),
            pytest.param(enums.COMPRESSION, pb.Compression, id="compression"),
            pytest.param(enums.ORIGIN, pb.Origin, id="origin"),
        ],
    )
    def test_no_number_of_the_wire_is_forgotten(
        self, table: dict[int, object], wire: type[pb.Axes]
    ) -> None:
        assert set(table) == set(wire.values())

    @pytest.mark.parametrize("decode", ["axes", "delivery", "origin"])
    def test_a_number_from_a_newer_peer_is_refused(self, decode: str) -> None:
        with pytest.raises(BadShape, match=f"{decode}: expected one of .* got 99"):
            getattr(codec, f"{decode}_from_proto")(99)


@pytest.mark.parametrize("code", ErrorCode)
@pytest.mark.parametrize("retry_after_s", [None, 0.5])
def test_the_error_of_a_frame_keeps_its_class(code: ErrorCode, retry_after_s: float | None) -> None:
    raised = ERROR_CLASSES[code]("the reason", retry_after_s=retry_after_s)
    message = codec.error_to_frame_error(7, raised)
    back = codec.error_from_frame_error(pb.FrameError.FromString(message.SerializeToString()))
    assert message.frame_id == 7
    assert type(back) is type(raised)
    assert isinstance(back, DepthError)
    assert (str(back), back.retry_after_s) == ("the reason", retry_after_s)


@pytest.mark.parametrize("code", ErrorCode)
@pytest.mark.parametrize("retry_after_s", [None, 0.5])
def test_an_error_keeps_its_class_as_a_status(code: ErrorCode, retry_after_s: float | None) -> None:
    status = codec.error_to_status(ERROR_CLASSES[code]("why", retry_after_s=retry_after_s), 3)
    back = codec.error_from_status(type(status).FromString(status.SerializeToString()))
    assert status.code == 3
    assert type(back) is ERROR_CLASSES[code]
    assert (str(back), back.retry_after_s) == ("why", retry_after_s)


def test_a_status_of_another_program_is_not_ours() -> None:
    status = codec.error_to_status(BadPose("why"), 3)
    info = error_details_pb2.ErrorInfo(reason="BAD_POSE", domain="example.com")
    status.details[0].Pack(info)
    assert codec.error_from_status(status) is None
    del status.details[:]
    assert codec.error_from_status(status) is None


def test_the_list_of_public_names_is_sorted_and_complete() -> None:
    public = {
        name
        for name, value in vars(codec).items()
        if not name.startswith("_") and not isinstance(value, ModuleType)
    }
    assert codec.__all__ == sorted(public)
