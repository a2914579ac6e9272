"""Where settings come from, and what is said about those that are not."""

from pathlib import Path

import pytest

from vergence_service.settings import Settings, SettingsError, load_settings


def test_flags_win_over_the_environment_and_that_over_the_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = tmp_path / "vergence.toml"
    config.write_text("[grpc]\nport = 1\ncredit = 7\nwaiting_frames = 5\n[model]\nthreads = 3\n")
    monkeypatch.setenv("VERGENCE_GRPC__PORT", "2")
    monkeypatch.setenv("VERGENCE_GRPC__CREDIT", "4")
    settings = load_settings(config=config, flags={"grpc.port": 3})
    grpc = settings.grpc
    assert (grpc.port, grpc.credit, grpc.waiting_frames) == (3, 4, 5)
    assert (settings.model.threads, settings.http.port) == (3, 8000)


def test_what_is_printed_says_the_same_when_read(tmp_path: Path) -> None:
    settings = load_settings(flags={"grpc.port": 0, "model.providers": ["cuda", "cpu"]})
    config = tmp_path / "printed.toml"
    config.write_text(settings.to_toml())
    assert load_settings(config=config).model_dump() == settings.model_dump()


def test_every_key_is_printed() -> None:
    text = Settings().to_toml()
    for name, section in Settings().model_dump().items():
        for key in section if isinstance(section, dict) else [name]:
            assert f"{key} " in text


def test_an_unknown_key_of_the_file_is_named_with_the_nearest_known(tmp_path: Path) -> None:
    config = tmp_path / "vergence.toml"
    config.write_text("[streams]\nidle_timeout = 5\n")
    with pytest.raises(SettingsError, match=r"streams\.idle_timeout'.*'streams\.idle_timeout_s'"):
        load_settings(config=config)


def test_an_unknown_variable_is_named_with_the_nearest_known(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("VERGENCE_MODEL__THREAD", "2")
    with pytest.raises(SettingsError, match=r"model\.thread'.*'model\.threads'"):
        load_settings()


@pytest.mark.parametrize(
    ("flags", "says"),
    [
        ({"grpc.port": "many"}, r"grpc\.port: .*got 'many'"),
        ({"streams.capacity": 0}, r"streams\.capacity: .*greater than 0"),
        ({"model.providers": ["tpu"]}, r"model\.providers.*'cuda'.*got 'tpu'"),
    ],
    ids=["not-a-number", "not-positive", "not-a-provider"],
)
def test_a_value_that_cannot_be_is_named_with_what_can(flags: dict[str, object], says: str) -> None:
    with pytest.raises(SettingsError, match=says):
        load_settings(flags=flags)


def test_a_file_that_is_not_toml_is_named(tmp_path: Path) -> None:
    config = tmp_path / "vergence.toml"
    config.write_text("[grpc\n")
    with pytest.raises(SettingsError, match=r"vergence\.toml is not TOML"):
        load_settings(config=config)


def test_a_folder_is_no_settings_file(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match="cannot read"):
        load_settings(config=tmp_path)
