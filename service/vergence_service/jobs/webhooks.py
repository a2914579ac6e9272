"""Webhooks: the server of a client hears of the end of its job.

Messages, signatures and retries are those of Standard Webhooks 1.0 (standardwebhooks.com). A
message may arrive twice; ``webhook-id`` is then the same. Addresses are restricted, since a client
chooses them and this server may reach what the client cannot: hosts need the operator's permission,
unlisted ones must be public, and no redirect is followed.
"""

import asyncio
import base64
import hashlib
import hmac
import ipaddress
import json
import logging
import os
import secrets
import socket
import ssl
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from urllib.parse import SplitResult, urlsplit

from vergence_proto.errors import BadShape
from vergence_service.jobs.job import Job
from vergence_service.jobs.registry import JobRegistry
from vergence_service.process.threads import ThreadPool

log = logging.getLogger(__name__)

_ANY_PUBLIC = "*"
_ANSWER_S = 15.0
# Pauses before the second attempt and later ones: all together a day.
_PAUSES_S = (1.0, 10.0, 60.0, 300.0, 1800.0, 7200.0, 18000.0, 28800.0, 28800.0)
_GONE = 410  # by the standard: send nothing more
_LOOK_EVERY_S = 30.0
_SECRET_PREFIX = "whsec_"
_PORTS = {"http": 80, "https": 443}

DELIVERED, GIVEN_UP = "delivered", "given up"


@dataclass(frozen=True, slots=True)
class _Target:
    url: SplitResult
    host: str
    port: int
    address: str  # that the host has, and that may be used


class WebhookHosts:
    """Decides which addresses a webhook may have."""

    def __init__(self, allowed: Sequence[str]) -> None:
        self._allowed = {host.lower() for host in allowed}

    async def target(self, webhook: str) -> _Target:
        """Return where to send a webhook. Raises BadShape: it may not go there."""
        if not self._allowed:
            raise BadShape(
                "this server sends no webhooks; its operator can allow hosts with the setting "
                "batch.webhook_hosts"
            )
        try:
            url = urlsplit(webhook)
            host, port = (url.hostname or "").lower(), url.port or _PORTS[url.scheme]
        except (KeyError, ValueError):
            host, port = "", 0
        if not host or url.username is not None or not webhook.isascii() or " " in webhook:
            raise BadShape(f"expected a webhook of https://HOST/PATH, got {webhook[:100]!r}")
        listed = host in self._allowed
        if not listed and (_ANY_PUBLIC not in self._allowed or url.scheme != "https"):
            raise BadShape(
                f"expected a webhook of https to a host that batch.webhook_hosts allows, got {host}"
            )
        try:
            loop = asyncio.get_running_loop()
            found = await loop.getaddrinfo(host, port, type=socket.SOCK_STREAM)
        except OSError as error:
            raise BadShape(f"the host {host} of the webhook is not known: {error}") from None
        addresses = [str(each[4][0]) for each in found]
        if not listed and not all(ipaddress.ip_address(each).is_global for each in addresses):
            raise BadShape(
                f"the webhook leads to a private address, {host}; only hosts that "
                "batch.webhook_hosts names may have one"
            )
        return _Target(url, host, port, addresses[0])


class WebhookSender:
    """Sends the webhooks of ended jobs, those of earlier servers too, between start and stop."""

    def __init__(
        self, jobs: JobRegistry, hosts: WebhookHosts, *, secret_file: Path, background: ThreadPool
    ) -> None:
        self._jobs = jobs
        self._hosts = hosts
        self._secret_file = secret_file
        self._background = background
        self._reading_secret = asyncio.Lock()  # the first reader makes the file
        self._failures: dict[str, int] = {}  # attempts in vain
        self._due_s: dict[str, float] = {}  # of the next attempt
        self._task: asyncio.Task[None] | None = None

    def start(self) -> None:
        """Send what is owed, until :meth:`stop`."""
        self._task = asyncio.create_task(self._run(), name="webhooks")

    async def stop(self) -> None:
        """Stop; the next server sends what is not delivered."""
        if self._task is not None:
            self._task.cancel()
            await asyncio.gather(self._task, return_exceptions=True)

    async def _run(self) -> None:
        while True:
            now_s = time.monotonic()
            owed = self._jobs.owing_webhooks()
            due = [job for job in owed if self._due_s.get(job.job_id, 0.0) <= now_s]
            if due:
                await asyncio.gather(*map(self._send, due))
                continue
            waits_s = [self._due_s[job.job_id] - now_s for job in owed]
            await self._jobs.change(within_s=min([*waits_s, _LOOK_EVERY_S]))

    async def _send(self, job: Job) -> None:
        try:
            status = await self._post(job)
            trouble = "" if 200 <= status < 300 else f"it answered {status}"
        except (OSError, TimeoutError, ValueError, BadShape, asyncio.IncompleteReadError) as error:
            status, trouble = 0, str(error) or type(error).__name__
        if not trouble:
            await self._end(job, DELIVERED)
            return
        failures = self._failures[job.job_id] = self._failures.get(job.job_id, 0) + 1
        if failures > len(_PAUSES_S) or status == _GONE:
            log.warning("the webhook of sequence %s is given up: %s", job.job_id, trouble)
            await self._end(job, GIVEN_UP)
            return
        log.info("the webhook of sequence %s failed: %s", job.job_id, trouble)
        self._due_s[job.job_id] = time.monotonic() + _PAUSES_S[failures - 1]

    async def _end(self, job: Job, result: str) -> None:
        self._failures.pop(job.job_id, None)
        self._due_s.pop(job.job_id, None)
        await self._jobs.note_webhook(job.job_id, result)

    async def _post(self, job: Job) -> int:
        target = await self._hosts.target(job.webhook)  # its address may be another one by now
        body = message_of(job)
        sent_s = int(time.time())
        async with self._reading_secret:
            secret = await self._background.run(webhook_secret, self._secret_file)
        url = target.url
        path = (url.path or "/") + (f"?{url.query}" if url.query else "")
        headers = {
            "Host": url.netloc,
            "Content-Type": "application/json",
            "Content-Length": str(len(body)),
            "User-Agent": "vergence",
            "webhook-id": f"msg_{job.job_id}",
            "webhook-timestamp": str(sent_s),
            "webhook-signature": signature_of(secret, f"msg_{job.job_id}", sent_s, body),
            "Connection": "close",
        }
        head = "".join(f"{name}: {value}\r\n" for name, value in headers.items())
        secure = ssl.create_default_context() if url.scheme == "https" else None
        async with asyncio.timeout(_ANSWER_S):
            reader, writer = await asyncio.open_connection(
                target.address,
                target.port,
                ssl=secure,
                server_hostname=target.host if secure else None,
            )
            try:
                writer.write(f"POST {path} HTTP/1.1\r\n{head}\r\n".encode() + body)
                await writer.drain()
                return int((await reader.readline()).split()[1])
            except IndexError:
                raise OSError("it closed the connection without an answer") from None
            finally:
                writer.close()
                with suppress(OSError):
                    await writer.wait_closed()


def message_of(job: Job) -> bytes:
    """Return the message about the end of a job."""
    assert job.finished_s is not None  # it has ended
    ended = datetime.fromtimestamp(job.finished_s, UTC).isoformat()
    return json.dumps(
        {
            "type": f"sequence.{job.state.value}",
            "timestamp": ended,
            "data": {
                "id": job.job_id,
                "state": job.state.value,
                "name": job.name,
                "labels": dict(job.labels),
                "frames": job.frames,
                "frames_failed": job.frames_failed,
                "reason": job.reason,
                "message": job.message,
            },
        }
    ).encode()


def signature_of(secret: str, message_id: str, sent_s: int, body: bytes) -> str:
    """Return the signature of a message by a secret of the form ``whsec_BASE64``."""
    key = base64.b64decode(secret.removeprefix(_SECRET_PREFIX))
    signed = f"{message_id}.{sent_s}.".encode() + body
    return "v1," + base64.b64encode(hmac.new(key, signed, hashlib.sha256).digest()).decode()


def webhook_secret(file: Path) -> str:
    """Return the secret in a file, which is made if it is not there."""
    with suppress(FileExistsError):
        descriptor = os.open(file, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o600)
        with open(descriptor, "w", encoding="ascii") as made:
            made.write(_SECRET_PREFIX + base64.b64encode(secrets.token_bytes(32)).decode())
    return file.read_text("ascii").strip()
