"""Whatever is wrong with where a source is said to be, the error says what there is."""

from pathlib import Path

import pytest

from tests.support import dataset_trees as trees
from tests.support.sources import opening
from vergence_proto.datasets import find_sources


class TestSpecs:
    @pytest.mark.parametrize("spec", ["", "room", "kitty:/tmp", ":/tmp"])
    def test_an_unknown_kind_names_the_known_ones(self, spec: str) -> None:
        assert "vergence:PATH, kitti:PATH, kitti2012:PATH" in opening(spec)

    def test_a_folder_that_is_not_there(self, tmp_path: Path) -> None:
        assert opening(f"vergence:{tmp_path}/a/b") == f"{tmp_path}/a/b: no such folder"

    def test_a_tree_of_sources_names_them(self, tmp_path: Path) -> None:
        for name in ("a", "b"):
            trees.vergence_sequence(tmp_path / name)
        message = opening(f"vergence:{tmp_path}")
        assert message.startswith(f"{tmp_path}/calib.json: not found")
        assert (
            f"name one of them: vergence:{tmp_path}/a/room, vergence:{tmp_path}/b/room" in message
        )

    def test_a_large_tree_names_some_and_counts_the_rest(self, tmp_path: Path) -> None:
        for k in range(14):
            trees.write_lines(tmp_path / str(k) / "calib.json", "{}")
            trees.write_image(tmp_path / str(k) / "left.png", trees.an_image(k))
        assert opening(f"vergence:{tmp_path}").endswith("and 2 more")

    def test_nothing_is_found_where_nothing_is(self, tmp_path: Path) -> None:
        assert find_sources(f"kitti:{tmp_path}") == []

    def test_an_option_of_another_layout(self, tmp_path: Path) -> None:
        assert "unknown option 'fx'; kitti: takes none" in opening(f"kitti:{tmp_path}?fx=3")

    def test_an_option_that_is_no_number(self, tmp_path: Path) -> None:
        assert "fx: could not convert" in opening(f"sceneflow:{tmp_path}?fx=wide")
