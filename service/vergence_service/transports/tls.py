"""The certificate of the server, for gRPC and HTTP. It is read again when its files change."""

import logging
import ssl
from pathlib import Path

import grpc

log = logging.getLogger(__name__)


class BadCertificate(ValueError):
    """A file of the settings [security] is no certificate or key, or they do not fit together."""


class Certificate:
    """A certificate with its key, and the authority of the clients' certificates, if any."""

    def __init__(self, certificate: Path, key: Path, client_ca: Path | None) -> None:
        """Read the files. Raises BadCertificate."""
        self._certificate, self._key, self._client_ca = certificate, key, client_ca
        self._seen = self._version()
        self._over_grpc = self._seen  # what gRPC has
        try:
            self.context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)  # for HTTP
            self.context.minimum_version = ssl.TLSVersion.TLSv1_2
            self.context.load_cert_chain(certificate, key)
            if client_ca is not None:
                self.context.load_verify_locations(client_ca)
                self.context.verify_mode = ssl.CERT_REQUIRED
            self._configuration = self._for_grpc()
        except (OSError, ssl.SSLError) as error:
            why = getattr(error, "strerror", None) or error
            raise BadCertificate(
                f"cannot use {certificate}, {key}{f' or {client_ca}' if client_ca else ''}: {why}"
            ) from None

    def grpc_credentials(self) -> grpc.ServerCredentials:
        """Return what a gRPC server needs; each handshake has the newest certificate."""
        return grpc.dynamic_ssl_server_credentials(
            self._configuration,
            self._newer,  # type: ignore[arg-type] # None: unchanged, as gRPC documents
            require_client_authentication=self._client_ca is not None,
        )

    def reload(self) -> None:
        """Read the files if they have changed. Files with errors change nothing."""
        seen = self._version()
        if seen == self._seen:
            return
        try:
            # First into a context that nobody uses: half a change would end every handshake.
            ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(self._certificate, self._key)
            self.context.load_cert_chain(self._certificate, self._key)
            self._configuration = self._for_grpc()
        except (OSError, ssl.SSLError) as error:
            log.error("the certificate stays as it was: %s", error)
            return
        finally:
            self._seen = seen
        log.info("read a new certificate from %s", self._certificate)

    def _newer(self) -> grpc.ServerCertificateConfiguration | None:
        """Return the certificate if it is newer than the one that gRPC has; gRPC calls this."""
        if self._over_grpc == self._seen:
            return None
        self._over_grpc = self._seen
        return self._configuration

    def _for_grpc(self) -> grpc.ServerCertificateConfiguration:
        pair = (self._key.read_bytes(), self._certificate.read_bytes())
        clients = self._client_ca.read_bytes() if self._client_ca else None
        return grpc.ssl_server_certificate_configuration([pair], root_certificates=clients)

    def _version(self) -> tuple[int, ...]:
        files = [self._certificate, self._key]
        try:
            return tuple(number for file in files for number in _stamp(file))
        except OSError:
            return ()


def _stamp(file: Path) -> tuple[int, int, int]:
    status = file.stat()
    return status.st_mtime_ns, status.st_size, status.st_ino
