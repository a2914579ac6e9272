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

from pydantic import BaseModel, ConfigDict, Field, PositiveFloat, PositiveInt, ValidationError
from pydantic_settings import BaseSettings, PydanticBaseSettingsSource, SettingsConfigDict
from pydantic_settings.sources import InitSettingsSource

from vergence_proto.text import decoded_text

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


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class ServerSettings(_Section):
    host: str = Field(default="127.0.0.1", description="address that every transport listens on")
    drain_s: PositiveFloat = Field(
        default=5.0, description="time that clients have to leave when the server shuts down"
    )


class GrpcSettings(_Section):
    host: str | None = Field(default=None, description="gRPC's own address; default: server.host")
    port: int = Field(default=50051, ge=0, le=65535, description="TCP port; 0 picks a free one")


class HttpSettings(_Section):
    host: str | None = Field(default=None, description="HTTP's own address; default: server.host")
    port: int = Field(default=8000, ge=0, le=65535, description="TCP port; 0 picks a free one")


class ZenohSettings(_Section):
    enabled: bool = Field(default=False, description="serve over Zenoh too")
    host: str | None = Field(
        default=None, description="address of the default listen endpoint; default: server.host"
    )
    namespace: str = Field(
        default="vergence",
        pattern=r"^[\w.-]+(/[\w.-]+)*$",
        description="prefix of every key",
    )
    mode: Literal["router", "peer", "client"] = Field(
        default="router",
        description="router listens; peer and client connect to the routers in connect",
    )
    listen: tuple[str, ...] = Field(
        default=(),
        description="endpoints to listen on; a router without any uses port 7447 of zenoh.host",
    )
    connect: tuple[str, ...] = Field(
        default=(), description="endpoints of routers and peers to connect to"
    )
    shared_memory: bool = Field(
        default=False,
        description="take messages of this machine from shared memory: quicker, but Zenoh keeps "
        "two descriptors of every client for ever",
    )
    config: Path | None = Field(
        default=None,
        description="Zenoh JSON5 file for TLS and access control; replaces mode and endpoints",
    )


class SecuritySettings(_Section):
    tls_cert: Path | None = Field(
        default=None, description="PEM file with the certificate for gRPC and HTTP; may be replaced"
    )
    tls_key: Path | None = Field(default=None, description="PEM file with its private key")
    client_ca: Path | None = Field(
        default=None,
        description="PEM file of the authority of client certificates; clients then need one",
    )
    tokens: Path | None = Field(
        default=None,
        description="file of tokens, of `vergence token`; clients then need one; may be changed",
    )
    hosts: tuple[str, ...] = Field(
        default=(), description='names of this server for HTTP without TLS; "*" allows any'
    )
    trusted_proxies: tuple[str, ...] = Field(
        default=(), description="addresses whose X-Forwarded-For is believed"
    )
    insecure: bool = Field(
        default=False, description="listen beyond this machine even without TLS and credentials"
    )


class ModelSettings(_Section):
    name: str = Field(default="lite", description="model of the manifest")
    weights: Path | None = Field(
        default=None, description="folder with a manifest.json; default: the installed weights"
    )
    providers: tuple[Literal["cpu", "cuda", "tensorrt", "openvino"], ...] = Field(
        default=("cpu",), min_length=1, description="execution providers in order of preference"
    )
    engine: Literal["auto", "native", "onnxruntime"] = Field(
        default="auto",
        description="what computes a step; auto: native for lite on a CPU, if it was built",
    )
    threads: int = Field(
        default=0, ge=0, description="threads that all steps share; 0 uses one per core"
    )
    allow_spinning: bool = Field(
        default=False, description="make steps faster by keeping idle threads busy"
    )
    iterations: PositiveInt = Field(default=1, description="iterations of a warm step")
    cold_iterations: PositiveInt = Field(
        default=5, description="most iterations of a live stream's cold step"
    )
    cold_iterations_every: PositiveInt = Field(
        default=8, description="most iterations of the cold step of a lossless stream or a pair"
    )
    min_range_share: float = Field(
        default=0.15,
        ge=0,
        le=1,
        description="reduce larger images until the search reaches this share of their width",
    )
    max_batch: PositiveInt = Field(
        default=1, description="streams that a GPU steps together; a CPU steps each by itself"
    )


class StreamSettings(_Section):
    capacity: PositiveInt = Field(default=16, description="most streams that are open at once")
    credit: PositiveInt = Field(
        default=2, description="most frames that a client may send before an answer returns"
    )
    paced_credit: PositiveInt = Field(
        default=12,
        description="the same for a live client that paces its frames by the link it measures",
    )
    waiting_frames: PositiveInt = Field(
        default=8, description="frames of a lossless stream that wait before its sender must wait"
    )
    idle_timeout_s: PositiveFloat = Field(
        default=60.0, description="close a connected stream that sends no frame for this long"
    )
    idle_notice_s: PositiveFloat = Field(
        default=10.0, description="warn the client this long before idle_timeout_s ends"
    )
    detach_grace_s: PositiveFloat = Field(
        default=10.0, description="keep a stream this long after its connection is lost"
    )


class LimitSettings(_Section):
    max_pixels: PositiveInt = Field(default=4_000_000, description="largest image, in pixels")
    max_frame_mib: PositiveInt = Field(
        default=32, description="largest message with one frame or one answer"
    )
    max_side_px: PositiveInt = Field(
        default=4096, description="largest width or height of an image"
    )
    max_state_mib: PositiveInt = Field(
        default=1024,
        description="memory of all streams: states, steps, images, maps and waiting frames",
    )
    connections: PositiveInt = Field(
        default=256,
        description="most connections over gRPC, and over HTTP; fewer if descriptors are scarce",
    )
    first_message_s: PositiveFloat = Field(
        default=10.0,
        description="time for the first message of a call, or for the headers of a request",
    )
    silent_s: PositiveFloat = Field(
        default=15.0,
        description="detach a client that pings, and then sends nothing for this long",
    )
    write_s: PositiveFloat = Field(
        default=10.0, description="disconnect a client that does not read an answer for this long"
    )
    min_kib_per_s: PositiveFloat = Field(
        default=16.0, description="slowest upload and download, in KiB per second"
    )
    pairs: PositiveInt = Field(
        default=8, description="most single pairs that wait or are stepped; one is stepped at once"
    )
    streams: PositiveInt = Field(
        default=4, description="most open streams of one principal; a token may allow others"
    )
    waiting_sequences: PositiveInt = Field(
        default=8, description="most unfinished sequences of one principal"
    )
    streams_per_client: PositiveInt | None = Field(
        default=None, description="most open streams of one address, over gRPC and HTTP"
    )


class ContinuitySettings(_Section):
    max_gap_s: PositiveFloat = Field(
        default=15.0,
        description="longest time between two frames; above detach_grace_s, so a resume is warm",
    )
    max_jump_m: PositiveFloat = Field(
        default=3.0, description="longest motion between two frames; a car at 10 Hz stays below"
    )
    max_jump_deg: PositiveFloat = Field(
        default=45.0,
        description="largest rotation between two frames; beyond it the views hardly overlap",
    )


class BatchSettings(_Section):
    directory: Path | None = Field(
        default=None,
        description="folder of jobs and results; default: $XDG_STATE_HOME/vergence/batch, or "
        "batch-PORT if another server uses that",
    )
    waiting: PositiveInt = Field(
        default=64, description="most unfinished sequences, the running one included"
    )
    waiting_per_client: PositiveInt | None = Field(
        default=None, description="most unfinished sequences of one address"
    )
    checkpoint_s: PositiveFloat = Field(
        default=2.0, description="seconds of work that a crash may cost"
    )
    keep_h: PositiveFloat = Field(
        default=24.0, description="hours that results are kept, fetched or not"
    )
    disk_mib: PositiveInt = Field(default=20_480, description="disk space of all jobs together")
    max_upload_mib: PositiveInt = Field(default=4096, description="largest upload")
    max_unpacked_mib: PositiveInt = Field(default=8192, description="largest unpacked archive")
    max_files: PositiveInt = Field(default=100_000, description="most files in one upload")
    max_ratio: PositiveFloat = Field(
        default=100.0, description="largest ratio of unpacked size to uploaded size"
    )
    idle_s: PositiveFloat = Field(
        default=30.0, description="abort an upload that sends nothing for this long"
    )


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
    server: ServerSettings = ServerSettings()
    grpc: GrpcSettings = GrpcSettings()
    http: HttpSettings = HttpSettings()
    zenoh: ZenohSettings = ZenohSettings()
    security: SecuritySettings = SecuritySettings()
    model: ModelSettings = ModelSettings()
    streams: StreamSettings = StreamSettings()
    limits: LimitSettings = LimitSettings()
    continuity: ContinuitySettings = ContinuitySettings()
    batch: BatchSettings = BatchSettings()

    def to_toml(self) -> str:
        """The settings as a file, with the meaning of each key."""
        sections = {name: value for name, value in self if isinstance(value, _Section)}
        lines = [f"log_level = {json.dumps(self.log_level)}"]
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


def _toml_lines(section: _Section) -> Iterable[str]:
    # Scalars and lists of strings are written alike in JSON and TOML, which has no null.
    for key, value in section.model_dump(mode="json").items():
        meaning = type(section).model_fields[key].description
        line = f"# {key} is not set" if value is None else f"{key} = {json.dumps(value)}"
        yield f"{line}  # {meaning}" if meaning else line
