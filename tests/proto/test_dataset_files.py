"""The two file formats of disparity."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from tests.support import dataset_trees as trees
from vergence_proto.datasets import (
    DatasetError,
    beyond_png,
    read_disparity_png,
    read_image,
    read_pfm,
    write_disparity_png,
    write_pfm,
)
from vergence_proto.types import Plane

SHAPES = st.tuples(st.integers(1, 9), st.integers(1, 9))
DISPARITIES = arrays.arrays(
    np.float32, SHAPES, elements=st.one_of(st.floats(-5, 300, width=32), st.just(float("nan")))
)
one_file = settings(suppress_health_check=[HealthCheck.function_scoped_fixture])


class TestDisparityPng:
    @one_file
    @given(disparity_px=DISPARITIES)
    def test_values_come_back_within_half_a_step(self, tmp_path: Path, disparity_px: Plane) -> None:
        path = tmp_path / "disparity.png"
        write_disparity_png(path, disparity_px)
        back = read_disparity_png(path)
        assert back.dtype == np.float32
        known = (disparity_px > 0) & (disparity_px < 255.99)
        np.testing.assert_array_equal(np.isnan(back), ~known)
        expected = np.maximum(disparity_px[known], 1 / 256)
        np.testing.assert_allclose(back[known], expected, rtol=1e-6, atol=1 / 512)

    def test_it_is_kitti_s_convention(self, tmp_path: Path) -> None:
        path = tmp_path / "disparity.png"
        values = np.array([[1, 2.5, np.nan, 0, 255.996, 256, 1000, np.inf]], np.float32)
        write_disparity_png(path, values)
        stored = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        assert stored is not None
        assert stored.dtype == np.uint16
        np.testing.assert_array_equal(stored, [[256, 640, 0, 0, 65535, 0, 0, 0]])
        np.testing.assert_array_equal(beyond_png(values), [[False] * 5 + [True] * 3])

    def test_half_a_file_is_an_error(self, tmp_path: Path) -> None:
        path = tmp_path / "disparity.png"
        write_disparity_png(path, trees.a_disparity())
        path.write_bytes(path.read_bytes()[:-20])
        with pytest.raises(DatasetError, match=r"disparity\.png: the PNG of .* cut short"):
            read_disparity_png(path)


class TestPfm:
    @one_file
    @given(values=DISPARITIES)
    def test_values_are_exact(self, tmp_path: Path, values: Plane) -> None:
        write_pfm(tmp_path / "a.pfm", values)
        np.testing.assert_array_equal(read_pfm(tmp_path / "a.pfm"), values)

    @pytest.mark.parametrize("order", ["<", ">"], ids=["little-endian", "big-endian"])
    def test_rows_go_upwards_in_either_byte_order(self, order: str, tmp_path: Path) -> None:
        trees.write_pfm_by_hand(tmp_path / "a.pfm", trees.a_disparity(), order)
        np.testing.assert_array_equal(read_pfm(tmp_path / "a.pfm"), trees.a_disparity())

    @pytest.mark.parametrize(
        "header",
        [
            b"Pf\r\n24 16\r\n-1.0\r\n",
            b"Pf\n# a comment\n24 16\n# and another\n-0.0039\n",
            b"Pf 24\n16 -1e0\n",
            b"Pf\n24 16\n-1\r\n",
        ],
        ids=["CR LF", "comments", "one line", "mixed"],
    )
    def test_headers_vary(self, header: bytes, tmp_path: Path) -> None:
        values = trees.a_disparity()
        (tmp_path / "a.pfm").write_bytes(header + values[::-1].astype("<f4").tobytes())
        np.testing.assert_array_equal(read_pfm(tmp_path / "a.pfm"), values)

    def test_an_explicit_plus_is_big_endian_and_padding_is_no_data(self, tmp_path: Path) -> None:
        values = trees.a_disparity()
        big = values[::-1].astype(">f4").tobytes()
        (tmp_path / "a.pfm").write_bytes(b"Pf\n24 16\n+1.0\n" + big + b"\0\0\n")
        np.testing.assert_array_equal(read_pfm(tmp_path / "a.pfm"), values)

    def test_opencv_reads_what_is_written(self, tmp_path: Path) -> None:
        values = np.nan_to_num(trees.a_disparity())
        write_pfm(tmp_path / "a.pfm", values)
        read = cv2.imread(str(tmp_path / "a.pfm"), cv2.IMREAD_UNCHANGED)
        np.testing.assert_array_equal(read, values)

    @pytest.mark.parametrize(
        ("data", "message"),
        [
            pytest.param(b"P5\n2 2\n255\n1234", "expected a PFM", id="another format"),
            pytest.param(b"PF\n1 1\n-1.0\n" + bytes(12), "colour", id="colour"),
            pytest.param(b"Pf\n2 2\n-1.0\n" + bytes(15), "needs 16 bytes", id="cut short"),
            pytest.param(b"Pf\n2 2\n-1.0\n" + bytes(16) + b"\1", "needs 16", id="too long"),
            pytest.param(b"", "expected a PFM", id="empty"),
            pytest.param(b"Pf\n2 2\n--\n" + bytes(16), "expected a PFM", id="no scale"),
        ],
    )
    def test_what_is_no_pfm_is_named(self, data: bytes, message: str, tmp_path: Path) -> None:
        path = tmp_path / "a.pfm"
        path.write_bytes(data)
        with pytest.raises(DatasetError, match=message) as caught:
            read_pfm(path)
        assert str(caught.value).startswith(f"{path}: ")


class TestImages:
    @pytest.mark.parametrize("name", ["a.png", "a.webp", "a.ppm"])
    def test_red_is_the_first_channel_in_every_format(self, name: str, tmp_path: Path) -> None:
        trees.write_image(tmp_path / name, trees.an_image(0))
        np.testing.assert_array_equal(read_image(tmp_path / name), trees.an_image(0))

    def test_grey_is_repeated(self, tmp_path: Path) -> None:
        grey = trees.an_image(0)[..., 0]
        trees.write_image(tmp_path / "a.png", grey)
        expected = np.repeat(grey[..., None], 3, axis=2)
        np.testing.assert_array_equal(read_image(tmp_path / "a.png"), expected)

    @pytest.mark.parametrize("name", ["a.png", "a.jpg", "a.webp", "a.ppm"])
    def test_half_an_image_is_an_error(self, name: str, tmp_path: Path) -> None:
        path = tmp_path / name
        trees.write_image(path, trees.an_image(0))
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
        with pytest.raises(DatasetError, match=name):
            read_image(path)

    def test_a_missing_image_is_named(self, tmp_path: Path) -> None:
        with pytest.raises(DatasetError, match=r"a\.png: not found"):
            read_image(tmp_path / "a.png")
