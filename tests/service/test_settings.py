"""Settings come from flags, environment and file; an error names the key to use."""

import re
import tomllib
from collections.abc import Mapping
from pathlib import Path

import pytest

from vergence_service.settings import Settings, SettingsError, load_settings


def test_flags_win_over_the_environment_and_that_over_the_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = tmp_path / "vergence.toml"
    config.write_text(
        "[grpc]\nport = 1\n[streams]\ncredit = 7\nwaiting_frames = 5\n[model]\nthreads = 3\n"
    )
    monkeypatch.setenv("VERGENCE_GRPC__PORT", "2")
    monkeypatch.setenv("VERGENCE_STREAMS__CREDIT", "4")
    settings = load_settings(config=config, flags={"grpc.port": 3})
    streams = settings.streams
    assert (settings.grpc.port, streams.credit, streams.waiting_frames) == (3, 4, 5)
    assert (settings.model.threads, settings.http.port) == (3, 8000)


def test_what_is_printed_says_the_same_when_read(tmp_path: Path) -> None:
    settings = load_settings(flags={"grpc.port": 0, "model.providers": ["cuda", "cpu"]})
    config = tmp_path / "printed.toml"
    config.write_text(settings.to_toml())
    assert load_settings(config=config).model_dump() == settings.model_dump()


def test_every_key_is_printed_in_its_table() -> None:
    # A key without a value is printed as a comment, for TOML has no null.
    text = re.sub(r"^# (\w+) is not set", r'\1 = "not set"', Settings().to_toml(), flags=re.M)
    printed = tomllib.loads(text)
    assert keys_per_table(printed) == keys_per_table(Settings().model_dump())


def keys_per_table(values: Mapping[str, object]) -> dict[str, set[str]]:
    tables = {"": {key for key, value in values.items() if not isinstance(value, dict)}}
    tables |= {key: set(value) for key, value in values.items() if isinstance(value, dict)}
    return tables


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("grpc.credit", "streams.credit"),
        ("grpc.waiting_frames", "streams.waiting_frames"),
        ("grpc.max_frame_mib", "limits.max_frame_mib"),
        ("grpc.drain_s", "server.drain_s"),
        ("streams.per_client", "limits.streams_per_client"),
        ("streams.max_state_mib", "limits.max_state_mib"),
        ("streams.max_pixels", "limits.max_pixels"),
    ],
)
def test_a_moved_key_still_works_and_is_named_with_its_new_place(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    old: str,
    new: str,
) -> None:
    table, _, name = new.partition(".")
    assert name in Settings().model_dump()[table]
    section, _, key = old.partition(".")
    config = tmp_path / "vergence.toml"
    config.write_text(f"[{section}]\n{key} = 5\n")
    says = f"'{re.escape(old)}'.*now called '{re.escape(new)}'"
    assert load_settings(config=config).model_dump()[table][name] == 5
    assert re.search(says, caplog.text)
    caplog.clear()
    monkeypatch.setenv(f"VERGENCE_{section}__{key}".upper(), "6")
    assert load_settings(config=config).model_dump()[table][name] == 6
    assert re.search(says, caplog.text)
    monkeypatch.setenv(f"VERGENCE_{new.replace('.', '__')}".upper(), "7")
    assert load_settings(config=config).model_dump()[table][name] == 7


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


SERVICE_LINKS = {
    "VERGENCE_PORT": "tcp://10.0.0.1:50051",
    "VERGENCE_SERVICE_HOST": "10.0.0.1",
    "VERGENCE_SERVICE_PORT": "50051",
    "VERGENCE_SERVICE_PORT_GRPC": "50051",
    "VERGENCE_PORT_50051_TCP": "tcp://10.0.0.1:50051",
    "VERGENCE_PORT_50051_TCP_ADDR": "10.0.0.1",
    "VERGENCE_PORT_53_UDP_PROTO": "udp",
    # Of services named vergence-grpc and vergence-model, whose names are also those of sections.
    "VERGENCE_GRPC_PORT": "tcp://10.0.0.2:50051",
    "VERGENCE_MODEL_SERVICE_HOST": "10.0.0.3",
    # Of a linked container.
    "VERGENCE_NAME": "/robot/vergence",
    "VERGENCE_ENV_PATH": "/usr/bin",
    "VERGENCE_ENV_VERGENCE_GRPC__PORT": "7",
}


def test_what_an_orchestrator_says_of_its_services_is_no_setting(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    before = load_settings().model_dump()
    for name, value in SERVICE_LINKS.items():
        monkeypatch.setenv(name, value)
    assert load_settings().model_dump() == before


@pytest.mark.parametrize(
    "name", ["VERGENCE_GRPC_PORT", "VERGENCE_PORT", "VERGENCE_MODEL_NAME", "VERGENCE_LOGLEVEL"]
)
def test_a_setting_with_too_few_underscores_is_reported(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(name, "50052")
    with pytest.raises(SettingsError, match="unknown setting"):
        load_settings()


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_a_file_may_start_with_a_byte_order_mark(encoding: str, tmp_path: Path) -> None:
    config = tmp_path / "vergence.toml"
    config.write_text("[grpc]\r\nport = 7\r\n", encoding)
    assert load_settings(config=config).grpc.port == 7


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
