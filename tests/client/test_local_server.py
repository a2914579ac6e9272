"""The settings of a server that a command starts for itself."""

import pytest

from vergence.cli.local_server import settings_for
from vergence_service.settings import load_settings


@pytest.mark.parametrize("pixels", [640 * 480, 3840 * 2160, 8192 * 6144])
def test_a_server_of_ones_own_has_room_for_the_images(
    pixels: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in settings_for(pixels).items():
        monkeypatch.setenv(name, value)
    limits = load_settings().limits
    assert limits.max_pixels >= pixels
    assert limits.max_frame_mib << 20 > 6 * pixels  # two images of three bytes a pixel
    assert limits.max_state_mib << 20 > 9 * pixels  # four times the state of lite
