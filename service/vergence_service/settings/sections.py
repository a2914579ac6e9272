"""The sections of the settings: every key, with its default and its meaning."""

from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, PositiveFloat, PositiveInt


class Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class ServerSettings(Section):
    host: str = Field(default="127.0.0.1", description="address that every transport listens on")
    drain_s: PositiveFloat = Field(
        default=5.0, description="time that clients have to leave when the server shuts down"
    )
    traces: bool = Field(
        default=False,
        description="export a span per frame by OpenTelemetry, whose OTEL_* variables say where "
        "to (needs the extra otel)",
    )


class GrpcSettings(Section):
    host: str | None = Field(default=None, description="gRPC's own address; default: server.host")
    port: int = Field(default=50051, ge=0, le=65535, description="TCP port; 0 picks a free one")


class HttpSettings(Section):
    host: str | None = Field(default=None, description="HTTP's own address; default: server.host")
    port: int = Field(default=8000, ge=0, le=65535, description="TCP port; 0 picks a free one")


class ZenohSettings(Section):
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


class SecuritySettings(Section):
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
    origins: tuple[str, ...] = Field(
        default=(),
        description="web pages that may call the HTTP API, as https://app.example (CORS)",
    )
    trusted_proxies: tuple[str, ...] = Field(
        default=(), description="addresses whose X-Forwarded-For is believed"
    )
    insecure: bool = Field(
        default=False, description="listen beyond this machine even without TLS and credentials"
    )


class AdminSettings(Section):
    host: str = Field(
        default="127.0.0.1", description="address of the metrics and of the administrator's calls"
    )
    port: int | None = Field(
        default=None, ge=0, le=65535, description="TCP port; default: 8001, or a free one"
    )
    images: bool = Field(
        default=True, description="let administrators see the images and the depth of streams"
    )


class ModelSettings(Section):
    name: str = Field(
        default="lite",
        description="model of the manifest, or a classical one: sgbm, sgbm-half, patchmatch",
    )
    weights: Path | None = Field(
        default=None,
        description="folder with a manifest.json; default: the installed weights, or what "
        "`vergence models add` wrote",
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


class StreamSettings(Section):
    capacity: PositiveInt = Field(default=64, description="most streams that are open at once")
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


class LimitSettings(Section):
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
        default=8,
        description="most single pairs that wait or are stepped, one at a time; a principal has "
        "half of them",
    )
    streams: PositiveInt = Field(
        default=4, description="most open streams of one principal; a token may allow others"
    )
    state_mib: PositiveInt = Field(
        default=256, description="memory of all streams of one principal, without steps"
    )
    megapixels_per_s: PositiveFloat = Field(
        default=100.0,
        description="a principal that has more stepped, left and right together, gets no further "
        "stream",
    )
    requests: PositiveInt = Field(
        default=64, description="most calls and requests of one principal that are open at once"
    )
    iterations: PositiveInt = Field(
        default=8, description="most iterations of a step that one principal may ask for"
    )
    waiting_sequences: PositiveInt = Field(
        default=8, description="most unfinished sequences of one principal"
    )
    sequences_mib: PositiveInt | None = Field(
        default=None,
        description="disk space of all uploads, sequences and results of one principal; default: "
        "half of what all may use",
    )
    streams_per_client: PositiveInt | None = Field(
        default=None,
        description="most open streams of one address; clients over Zenoh without a token count as "
        "one",
    )


class ContinuitySettings(Section):
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


class SnapshotSettings(Section):
    store: str = Field(
        default="none",
        pattern=r"^(none|rediss?://\S+|unix://\S+)$",
        description="where the states of streams are kept for other servers: none, or "
        "redis://HOST:PORT/DATABASE (needs the extra fleet)",
    )
    timeout_s: PositiveFloat = Field(
        default=1.0, description="abandon a call of the store after this long; no frame waits"
    )


class BatchSettings(Section):
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
    disk_mib: PositiveInt | None = Field(
        default=None, description="disk space of all jobs together; default: the whole disk"
    )
    max_upload_mib: PositiveInt | None = Field(
        default=None,
        description="largest upload; default: what is free when the server starts",
    )
    max_unpacked_mib: PositiveInt | None = Field(
        default=None, description="largest unpacked archive; default: as for uploads"
    )
    max_files: PositiveInt = Field(default=100_000, description="most files in one upload")
    max_ratio: PositiveFloat = Field(
        default=100.0, description="largest ratio of unpacked size to uploaded size"
    )
    servers: str = Field(
        default="none",
        pattern=r"^(none|rediss?://\S+|unix://\S+)$",
        description="where servers behind one front note which of them has a job, so that each "
        "answers for all: none, or redis://HOST:PORT/DATABASE (needs the extra fleet)",
    )
    address: str | None = Field(
        default=None,
        pattern=r"^https?://[^/\s]+$",
        description="URL of this server's HTTP port for the others of batch.servers; default: "
        "where it listens, or the address of its host name",
    )
    idle_s: PositiveFloat = Field(
        default=30.0, description="abort an upload that sends nothing for this long"
    )
    inputs: list[Annotated[str, Field(pattern=r"^[\w.-]+=.+$")]] = Field(
        default=[], description="folders that jobs may read without an upload, as NAME=PATH"
    )
    webhook_hosts: list[str] = Field(
        default=[], description='hosts that webhooks may go to; "*": any with a public address'
    )
