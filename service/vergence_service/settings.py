"""What an operator may set, and where it comes from: flags, then the environment, then a file."""

import difflib
import json
import os
import tomllib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, PositiveFloat, PositiveInt, ValidationError
from pydantic_settings import BaseSettings, PydanticBaseSettingsSource, SettingsConfigDict
from pydantic_settings.sources import InitSettingsSource

ENV_PREFIX = "VERGENCE_"
_NESTED = "__"


class SettingsError(ValueError):
    """A setting is unknown, or its value is not one."""


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class GrpcSettings(_Section):
    host: str = "127.0.0.1"
    port: int = Field(default=50051, ge=0, le=65535, description="0: a free one")
    credit: PositiveInt = Field(default=2, description="frames that a client may have unanswered")
    waiting_frames: PositiveInt = Field(
        default=8, description="of a lossless stream, before it waits"
    )
    max_frame_mib: PositiveInt = 32
    drain_s: PositiveFloat = Field(
        default=5.0, description="for clients to leave before they are ended"
    )


class HttpSettings(_Section):
    host: str = "127.0.0.1"
    port: int = Field(default=8000, ge=0, le=65535, description="0: a free one")


class BatchSettings(_Section):
    directory: Path | None = Field(
        default=None, description="of jobs and results; $XDG_STATE_HOME/vergence/batch"
    )
    waiting: PositiveInt = Field(default=64, description="sequences, the running one included")
    waiting_per_client: PositiveInt | None = Field(default=None, description="those of one address")
    checkpoint_s: PositiveFloat = Field(default=2.0, description="of work that a crash may cost")
    keep_h: PositiveFloat = Field(default=24.0, description="results, unless space runs short")
    disk_mib: PositiveInt = Field(default=20_480, description="of all jobs together")
    max_upload_mib: PositiveInt = 4096
    max_unpacked_mib: PositiveInt = 8192
    max_files: PositiveInt = Field(default=100_000, description="in one upload")
    max_ratio: PositiveFloat = Field(default=100.0, description="of unpacked to uploaded size")
    idle_s: PositiveFloat = Field(default=30.0, description="before a silent upload is given up")


class ZenohSettings(_Section):
    enabled: bool = False
    namespace: str = Field(
        default="vergence",
        pattern=r"^[\w.-]+(/[\w.-]+)*$",
        description="the first chunks of every key",
    )
    mode: Literal["router", "peer", "client"] = Field(
        default="router", description="client or peer: joins the routers of connect"
    )
    listen: tuple[str, ...] = Field(
        default=(), description="endpoints; a router without one: port 7447 on the host of gRPC"
    )
    connect: tuple[str, ...] = Field(default=(), description="endpoints of routers and peers")
    config: Path | None = Field(
        default=None,
        description="a Zenoh JSON5 file, for TLS and access control; instead of mode and endpoints",
    )


class ModelSettings(_Section):
    name: str = "lite"
    weights: Path | None = Field(
        default=None, description="a folder with a manifest; the packaged one"
    )
    providers: tuple[Literal["cpu", "cuda", "tensorrt", "openvino"], ...] = Field(
        default=("cpu",), min_length=1, description="in order of preference"
    )
    threads: int = Field(default=0, ge=0, description="of all steps; 0: one a core")
    allow_spinning: bool = Field(default=False, description="quicker steps, for all of a core")
    iterations: PositiveInt = Field(default=1, description="of a warm step")
    cold_iterations: PositiveInt = Field(default=5, description="of a live cold start, at most")
    cold_iterations_every: PositiveInt = Field(
        default=8, description="the same of a stream that wants every frame: no frame is in a hurry"
    )
    max_batch: PositiveInt = Field(
        default=1, description="streams stepped together on a GPU; a CPU steps each by itself"
    )


class StreamSettings(_Section):
    capacity: PositiveInt = 16
    per_client: PositiveInt | None = Field(
        default=None, description="streams of one address, over gRPC and HTTP"
    )
    max_state_mib: PositiveInt = 512
    max_pixels: PositiveInt = Field(default=4_000_000, description="of one image")
    idle_timeout_s: PositiveFloat = 60.0
    idle_notice_s: PositiveFloat = Field(default=10.0, description="before the timeout")
    detach_grace_s: PositiveFloat = Field(
        default=10.0, description="for a lost client to come back"
    )


class ContinuitySettings(_Section):
    max_gap_s: PositiveFloat = Field(
        default=15.0, description="above the grace, so a resume is warm"
    )
    max_jump_m: PositiveFloat = Field(default=3.0, description="a car between two frames at 10 Hz")
    max_jump_deg: PositiveFloat = Field(default=45.0, description="past it little is seen by both")


class Settings(BaseSettings):
    """All settings of one server."""

    model_config = SettingsConfigDict(
        extra="forbid",
        frozen=True,
        env_prefix=ENV_PREFIX,
        env_nested_delimiter=_NESTED,
    )

    grpc: GrpcSettings = GrpcSettings()
    http: HttpSettings = HttpSettings()
    zenoh: ZenohSettings = ZenohSettings()
    batch: BatchSettings = BatchSettings()
    model: ModelSettings = ModelSettings()
    streams: StreamSettings = StreamSettings()
    continuity: ContinuitySettings = ContinuitySettings()
    log_level: Literal["debug", "info", "warning", "error"] = "info"

    def to_toml(self) -> str:
        """As a file that says the same, with what each key means."""
        sections = {name: value for name, value in self if isinstance(value, _Section)}
        lines = [f"log_level = {json.dumps(self.log_level)}"]
        for name, section in sections.items():
            lines += ["", f"[{name}]", *_toml_lines(section)]
        return "\n".join(lines) + "\n"


def load_settings(
    *, config: Path | None = None, flags: Mapping[str, Any] | None = None
) -> Settings:
    """Flags win over ``VERGENCE_*`` variables, and those over the file.

    Keys are dotted in ``flags`` ("grpc.port"), nested with ``__`` in the environment
    (``VERGENCE_GRPC__PORT``), sections in the file. Raises SettingsError.
    """
    from_file = _read(config) if config else {}
    _check_known(_dotted(from_file), f"in {config}")
    _check_known(
        (
            name.removeprefix(ENV_PREFIX).lower().replace(_NESTED, ".")
            for name in os.environ
            if name.startswith(ENV_PREFIX)
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
            return init_settings, env_settings, InitSettingsSource(settings_cls, from_file)

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
        return tomllib.loads(path.read_text("utf-8"))
    except OSError as error:
        raise SettingsError(f"cannot read {path}: {error.strerror}") from None
    except tomllib.TOMLDecodeError as error:
        raise SettingsError(f"{path} is not TOML: {error}") from None


def _check_known(keys: Iterable[str], where: str) -> None:
    known = list(_dotted(Settings.model_construct().model_dump()))
    for key in keys:
        if key not in known:
            nearest = difflib.get_close_matches(key, known, n=1, cutoff=0.0)
            raise SettingsError(f"unknown setting {key!r} {where}; the nearest is {nearest[0]!r}")


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


def _toml_lines(section: _Section) -> Iterable[str]:
    # Scalars and lists of strings are written alike in JSON and TOML, which has no null.
    for key, value in section.model_dump(mode="json").items():
        meaning = type(section).model_fields[key].description
        line = f"# {key} is not set" if value is None else f"{key} = {json.dumps(value)}"
        yield f"{line}  # {meaning}" if meaning else line
