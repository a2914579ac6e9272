"""The gate: it turns the credential of a request into a principal."""

from collections.abc import Sequence

from vergence_proto.errors import Unauthenticated
from vergence_service.access.principals import LOCAL, Principal, checked_name
from vergence_service.access.requests import OpenRequests
from vergence_service.access.tokens import Tokens

_BEARER = "bearer "
_CERTIFICATE = "certificate:"


class Gate:
    """Knows the tokens of a server, and whether its clients have certificates."""

    def __init__(
        self,
        tokens: Tokens | None = None,
        *,
        certificates: bool = False,
        most_requests: int | None = None,
    ) -> None:
        self.requests = OpenRequests(most_requests)
        self._tokens = tokens
        self._certificates = certificates

    @property
    def open(self) -> bool:
        """True if no credential is asked for: every caller is ``local``."""
        return self._tokens is None and not self._certificates

    @property
    def tokens(self) -> Tokens | None:
        """The tokens, or None if the server has no file of tokens."""
        return self._tokens

    def caller(self, authorization: str | None, certificate_names: Sequence[str] = ()) -> Principal:
        """Return the principal of a request.

        ``authorization`` is the header of this name. ``certificate_names`` are the names in the
        client's certificate, which TLS has checked.

        Raises Unauthenticated if the request has no valid credential.
        """
        if self.open:
            return LOCAL
        if self._tokens is not None and authorization:
            if authorization[: len(_BEARER)].lower() == _BEARER:
                token = authorization[len(_BEARER) :].strip()
                if principal := self._tokens.principal_of(token):
                    return principal
            raise Unauthenticated("the token is not valid; ask the server's operator for another")
        if self._certificates:
            return _of_certificate(certificate_names)
        raise Unauthenticated(
            "this server asks for a token; set VERGENCE_TOKEN, or VERGENCE_TOKEN_FILE to a file "
            "with it"
        )

    def named(self, name: str) -> Principal:
        """Return the principal that Zenoh has authenticated as ``name``. Raises Unauthenticated."""
        if self.open:
            return LOCAL
        if self._tokens is not None and name in self._tokens.names():
            return Principal(name, credential=f"zenoh:{name}")
        raise Unauthenticated("no such user; ask the server's operator")

    def valid(self, principal: str, credential: str) -> bool:
        """Return True unless the credential has been removed since it was shown."""
        if self._tokens is None or not credential or credential.startswith(_CERTIFICATE):
            return True
        if credential.startswith("zenoh:"):
            return principal in self._tokens.names()
        return self._tokens.valid(credential)


def _of_certificate(names: Sequence[str]) -> Principal:
    for name in names:
        try:
            return Principal(checked_name(name), credential=_CERTIFICATE + name)
        except ValueError:
            continue
    raise Unauthenticated("expected a certificate whose name is that of a principal")
