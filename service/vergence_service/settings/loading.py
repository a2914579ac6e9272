"""The server's settings, read from flags, environment variables and a file, in this order."""

import difflib
import json
import logging
import os
import re
import tomllib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, ValidationError
from pydantic_settings import BaseSettings, PydanticBaseSettingsSource, SettingsConfigDict
from pydantic_settings.sources import InitSettingsSource

from vergence_proto.text import decoded_text
from vergence_service.settings.sections import (
    AdminSettings,
    BatchSettings,
    ContinuitySettings,
    GrpcSettings,
    HttpSettings,
    LimitSettings,
    ModelSettings,
    Section,
    SecuritySettings,
    ServerSettings,
    SnapshotSettings,
    StreamSettings,
    ZenohSettings,
)

log = logging.getLogger(__name__)

ENV_PREFIX = "VERGENCE_"
_NESTED = "__"
# Kubernetes and Docker describe a service or container named vergence or vergence-... in variables
# of every pod and container beside it, as VERGENCE_PORT=tcp://10.0.0.1:50051. No setting has such a
# name and value; VERGENCE_GRPC_PORT=1 is a misspelt setting.
_SERVICE_LINK = re.compile(
    ENV_PREFIX
    + r"(\w+_)?(SERVICE_HOST=|SERVICE_PORT(_\w+)?=|PORT=\w+://|PORT_\d+_\w+=|NAME=/|ENV_\w+=)"
)


# Variables of the client, which may be in the same environment.
_OF_CLIENTS = {"VERGENCE_TOKEN", "VERGENCE_TOKEN_FILE", "VERGENCE_CA"}


class SettingsError(ValueError):
    """A setting is unknown, or its value is not allowed."""


# Keys that had another name in earlier versions. They still work, with a warning.
_MOVED: Mapping[str, str] = {
    "grpc.credit": "streams.credit",
    "grpc.waiting_frames": "streams.waiting_frames",
    "grpc.max_frame_mib": "limits.max_frame_mib",
    "grpc.drain_s": "server.drain_s",
    "streams.per_client": "limits.streams_per_client",
    "streams.max_state_mib": "limits.max_state_mib",
    "streams.max_pixels": "limits.max_pixels",
}


class Settings(BaseSettings):
    """All settings of one server."""

    model_config = SettingsConfigDict(
        extra="forbid",
        frozen=True,
        env_prefix=ENV_PREFIX,
        env_nested_delimiter=_NESTED,
    )

    log_level: Literal["debug", "info", "warning", "error"] = Field(
        default="info", description="least severe messages to log"
    )
    log_format: Literal["text", "json"] = Field(
        default="text", description="form of the log's lines; json: in UTC, with fields"
    )
    server: ServerSettings = ServerSettings()
    grpc: GrpcSettings = GrpcSettings()
    http: HttpSettings = HttpSettings()
    zenoh: ZenohSettings = ZenohSettings()
    security: SecuritySettings = SecuritySettings()
    admin: AdminSettings = AdminSettings()
    model: ModelSettings = ModelSettings()
    streams: StreamSettings = StreamSettings()
    limits: LimitSettings = LimitSettings()
    continuity: ContinuitySettings = ContinuitySettings()
    snapshots: SnapshotSettings = SnapshotSettings()
    batch: BatchSettings = BatchSettings()

    def to_toml(self) -> str:
        """The settings as a file, with the meaning of each key."""
        sections = {name: value for name, value in self if isinstance(value, Section)}
        lines = [
            f"log_level = {json.dumps(self.log_level)}",
            f"log_format = {json.dumps(self.log_format)}",
        ]
        for name, section in sections.items():
            lines += ["", f"[{name}]", *_toml_lines(section)]
        return "\n".join(lines) + "\n"


def load_settings(
    *, config: Path | None = None, flags: Mapping[str, Any] | None = None
) -> Settings:
    """Read the settings: flags win over ``VERGENCE_*`` variables, and variables over the file.

    A key is written "grpc.port" in ``flags``, ``VERGENCE_GRPC__PORT`` in the environment, and
    ``port`` in the section ``[grpc]`` of the file.

    Raises SettingsError if a key is unknown, a value is not allowed or the file cannot be read.
    """
    from_file = _with_new_names(_read(config) if config else {}, f"in {config}")
    _check_known(_dotted(from_file), f"in {config}")
    _check_known(
        (
            name.removeprefix(ENV_PREFIX).lower().replace(_NESTED, ".")
            for name, value in os.environ.items()
            if name.startswith(ENV_PREFIX)
            and name not in _OF_CLIENTS
            and not _SERVICE_LINK.match(f"{name}={value}")
        ),
        f"in the environment ({ENV_PREFIX}...)",
    )

    class Sourced(Settings):
        @classmethod
        def settings_customise_sources(
            cls,
            settings_cls: type[BaseSettings],
            init_settings: PydanticBaseSettingsSource,
            env_settings: PydanticBaseSettingsSource,
            dotenv_settings: PydanticBaseSettingsSource,
            file_secret_settings: PydanticBaseSettingsSource,
        ) -> tuple[PydanticBaseSettingsSource, ...]:
            variables = _with_new_names(env_settings(), f"in the environment ({ENV_PREFIX}...)")
            return (
                init_settings,
                InitSettingsSource(settings_cls, variables),
                InitSettingsSource(settings_cls, from_file),
            )

    try:
        return Sourced(**_nested(flags or {}))
    except ValidationError as error:
        problems = (
            f"{'.'.join(map(str, problem['loc']))}: {problem['msg']}, got {problem['input']!r}"
            for problem in error.errors()
        )
        raise SettingsError("; ".join(problems)) from None


def _read(path: Path) -> dict[str, Any]:
    try:
        text = decoded_text(path.read_bytes())
    except OSError as error:
        raise SettingsError(f"cannot read {path}: {error.strerror}") from None
    if text is None:
        raise SettingsError(f"cannot read {path}: it is not text")
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise SettingsError(f"{path} is not TOML: {error}") from None


def _check_known(keys: Iterable[str], where: str) -> None:
    known = [*_dotted(Settings.model_construct().model_dump()), *_MOVED]
    for key in keys:
        if key not in known:
            nearest = difflib.get_close_matches(key, known[: -len(_MOVED)], n=1, cutoff=0.0)
            raise SettingsError(f"unknown setting {key!r} {where}; the nearest is {nearest[0]!r}")


def _with_new_names(values: dict[str, Any], where: str) -> dict[str, Any]:
    """Move the values of old keys to their new places, unless those are set too."""
    for old, new in _MOVED.items():
        section, _, key = old.partition(".")
        if isinstance(values.get(section), dict) and key in values[section]:
            _warn_moved(old, where)
            value = values[section].pop(key)
            target, _, name = new.partition(".")
            values.setdefault(target, {}).setdefault(name, value)
    return values


def _warn_moved(key: str, where: str) -> None:
    log.warning("setting %r %s is now called %r", key, where, _MOVED[key])


def _dotted(values: Mapping[str, Any], prefix: str = "") -> Iterable[str]:
    for key, value in values.items():
        if isinstance(value, Mapping):
            yield from _dotted(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}"


def _nested(flags: Mapping[str, Any]) -> dict[str, Any]:
    nested: dict[str, Any] = {}
    for key, value in flags.items():
        section, _, name = key.rpartition(".")
        (nested.setdefault(section, {}) if section else nested)[name] = value
    return nested


def _toml_lines(section: Section) -> Iterable[str]:
    # Scalars and lists of strings are written alike in JSON and TOML, which has no null.
    for key, value in section.model_dump(mode="json").items():
        meaning = type(section).model_fields[key].description
        line = f"# {key} is not set" if value is None else f"{key} = {json.dumps(value)}"
        yield f"{line}  # {meaning}" if meaning else line
