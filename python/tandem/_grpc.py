"""Servers and channels: addresses, tokens, TLS and health, as in all services of Tandem."""

from __future__ import annotations

import hmac
import ipaddress
import os
import pathlib
import socket
import ssl
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from types import TracebackType
from typing import Any, TypeVar

os.environ.setdefault("GRPC_VERBOSITY", "NONE")  # Failures are raised; the library's own log would repeat them.

try:
    import grpc as grpc
except ImportError as error:
    raise ImportError("servers, clients and ServedEnv of tandem need gRPC: pip install 'tandem-rl[grpc]'") from error

Path = str | os.PathLike[str]

MAX_MESSAGE_BYTES = 64 << 20
"""The largest message, as in the other services."""
_OPTIONS = [
    ("grpc.max_send_message_length", MAX_MESSAGE_BYTES),
    ("grpc.max_receive_message_length", MAX_MESSAGE_BYTES),
]
# A connection whose other end is gone or hangs fails after twenty seconds, also while a stream waits.
_KEEP_ALIVE = [
    ("grpc.keepalive_time_ms", 10_000),
    ("grpc.keepalive_timeout_ms", 10_000),
    # The time for the answer to a ping. It is a minute by default, whatever the timeout above is.
    ("grpc.http2.ping_timeout_ms", 10_000),
]
_CHANNEL_OPTIONS = [
    *_OPTIONS,
    *_KEEP_ALIVE,
    ("grpc.http2.max_pings_without_data", 0),
]
_SERVER_OPTIONS = [
    *_OPTIONS,
    *_KEEP_ALIVE,
    # Ports are not shared: a second server on the same port fails.
    ("grpc.so_reuseport", 0),
    # All clients of Tandem probe idle connections; without these the server would close them as too busy.
    ("grpc.keepalive_permit_without_calls", 1),
    ("grpc.http2.max_ping_strikes", 0),
]
_UNARY_THREADS = 4
_SERVING = b"\x08\x01"
"""An encoded `grpc.health.v1.HealthCheckResponse` with status SERVING."""


class ServiceError(Exception):
    """A server that cannot start, an environment that cannot be served, or a peer that refuses a call.

    The message says what to do.
    """


class Refused(Exception):
    """A request that a service refuses, with the status code of the response."""

    def __init__(self, code: grpc.StatusCode, message: str) -> None:
        super().__init__(message)
        self.code = code


def read_token(path: Path) -> str:
    """Returns the access token in a file, without surrounding whitespace."""
    try:
        token = pathlib.Path(path).read_bytes()[: 64 << 10].strip().decode("ascii")
    except OSError as error:
        raise ServiceError(f"cannot read {os.fspath(path)!r}: {error.strerror}") from error
    except UnicodeDecodeError:
        token = ""
    if not 16 <= len(token) <= 1024 or not all("!" <= character <= "~" for character in token):
        raise ServiceError(f"{os.fspath(path)!r} does not hold a token: 16 to 1024 printable ASCII characters")
    return token


def parse_address(text: str) -> tuple[str, int]:
    """Returns host and port of `HOST:PORT`, `[IPV6]:PORT` or `http://HOST:PORT`."""
    host, _, port = text.removeprefix("https://").removeprefix("http://").rstrip("/").rpartition(":")
    if not host or "/" in host or not port.isascii() or not port.isdigit() or int(port) > 65535:
        raise ServiceError(f"{text!r} is not an address: expected HOST:PORT")
    return host, int(port)


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return host == "localhost"


def _read(path: Path) -> bytes:
    try:
        return pathlib.Path(path).read_bytes()
    except OSError as error:
        raise ServiceError(f"cannot read {os.fspath(path)!r}: {error.strerror}") from error


def _check_certificate(certificate: Path, key: Path) -> None:
    """Refuses a certificate or key that cannot be used, which gRPC would report as an address in use."""
    for path in (certificate, key):
        _read(path)
    try:
        ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(certificate, key, password="")
    except (OSError, ValueError) as error:
        names = f"certificate {os.fspath(certificate)!r} with key {os.fspath(key)!r}"
        raise ServiceError(f"cannot use {names}: {error}") from error


class _RequireToken(grpc.ServerInterceptor):  # type: ignore[misc]
    """Refuses calls without the token, except health checks, before their requests are decoded."""

    def __init__(self, token: str) -> None:
        self._expected = f"Bearer {token}".encode()

    def intercept_service(self, continuation: Any, details: Any) -> Any:
        sent = next((value for key, value in details.invocation_metadata if key == "authorization"), "")
        if isinstance(sent, str):
            sent = sent.encode("utf-8", "replace")
        if hmac.compare_digest(sent, self._expected) or details.method.startswith("/grpc.health."):
            return continuation(details)
        message = "missing or wrong token: give the token file of the server"

        def refuse(_request: Any, context: Any) -> None:
            context.abort(grpc.StatusCode.UNAUTHENTICATED, message)

        handler = continuation(details)
        if handler is not None and handler.request_streaming:
            return grpc.stream_stream_rpc_method_handler(refuse)
        return grpc.unary_unary_rpc_method_handler(refuse)


_ServerT = TypeVar("_ServerT", bound="Server")


class Server:
    """A running server: a context manager that stops it, with the address in `address`."""

    def __init__(
        self,
        add_service: Callable[[grpc.Server], None],
        *,
        listen: str = "127.0.0.1:0",
        token_file: Path | None = None,
        tls_cert: Path | None = None,
        tls_key: Path | None = None,
        insecure: bool = False,
        max_streams: int = 0,
        on_stop: Callable[[], None] = lambda: None,
    ) -> None:
        host, port = parse_address(listen)
        if not _is_loopback(host) and token_file is None and not insecure:
            raise ServiceError(
                f"{listen} can be reached from other machines: give a token file (and a TLS certificate and key), "
                "or insecure to do without"
            )
        if (tls_cert is None) != (tls_key is None):
            raise ServiceError("TLS needs both a certificate and its key")
        interceptors = [] if token_file is None else [_RequireToken(read_token(token_file))]
        threads = ThreadPoolExecutor(max_streams + _UNARY_THREADS, thread_name_prefix="tandem")
        server = grpc.server(threads, interceptors=interceptors, options=_SERVER_OPTIONS)
        add_service(server)
        health = {"Check": grpc.unary_unary_rpc_method_handler(lambda _request, _context: _SERVING)}
        server.add_generic_rpc_handlers((grpc.method_handlers_generic_handler("grpc.health.v1.Health", health),))
        try:
            if tls_cert is not None and tls_key is not None:
                _check_certificate(tls_cert, tls_key)
                credentials = grpc.ssl_server_credentials([(_read(tls_key), _read(tls_cert))])
                bound = server.add_secure_port(f"{host}:{port}", credentials)
            else:
                bound = server.add_insecure_port(f"{host}:{port}")
        except RuntimeError as error:
            raise ServiceError(f"cannot listen on {listen}: the address is in use or not of this machine") from error
        server.start()
        self.address = f"{'http' if tls_cert is None else 'https'}://{host}:{bound}"
        """The address of the server, `http://HOST:PORT`, or `https://HOST:PORT` with TLS."""
        self._server = server
        self._on_stop = on_stop
        self._stopped = threading.Event()

    def stop(self, grace_s: float = 1.0) -> None:
        """Stops the server. Open calls have `grace_s` seconds to end."""
        self._on_stop()
        self._server.stop(grace_s).wait()
        self._stopped.set()

    def wait(self) -> None:
        """Waits until the server is stopped."""
        while not self._stopped.wait(0.5):
            pass  # A short wait lets Python handle signals on all systems.

    def __enter__(self: _ServerT) -> _ServerT:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()


def open_channel(address: str, token_file: Path | None = None, tls_ca: Path | None = None) -> grpc.Channel:
    """Returns a channel to `HOST:PORT` or a URI, which uses TLS if `tls_ca` names a trusted authority (PEM)."""
    host, port = parse_address(address)
    if address.startswith("https://") and tls_ca is None:
        raise ServiceError(f"{address} requires TLS: give its authority's certificate as tls_ca")
    target = f"{host}:{port}"
    if tls_ca is None:
        channel = grpc.insecure_channel(target, options=_CHANNEL_OPTIONS)
    else:
        channel = grpc.secure_channel(target, grpc.ssl_channel_credentials(_read(tls_ca)), options=_CHANNEL_OPTIONS)
    if token_file is None:
        return channel
    return grpc.intercept_channel(channel, _SendToken(read_token(token_file)))


def uses_tls(address: str, timeout_s: float) -> bool:
    """Returns whether a server at the address answers a TLS handshake."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    host, port = parse_address(address)
    try:
        with socket.create_connection((host.strip("[]"), port), timeout_s) as connection:
            context.wrap_socket(connection, server_hostname=host.strip("[]")).close()
        return True
    except (OSError, ValueError):
        return False


class _CallDetails(grpc.ClientCallDetails):  # type: ignore[misc]
    """The details of a call, with metadata added."""

    def __init__(self, details: Any, metadata: list[tuple[str, str]]) -> None:
        self.method = details.method
        self.timeout = details.timeout
        self.metadata = [*(details.metadata or []), *metadata]
        self.credentials = details.credentials
        self.wait_for_ready = getattr(details, "wait_for_ready", None)
        self.compression = getattr(details, "compression", None)


class _SendToken(
    grpc.UnaryUnaryClientInterceptor,  # type: ignore[misc]
    grpc.UnaryStreamClientInterceptor,  # type: ignore[misc]
    grpc.StreamStreamClientInterceptor,  # type: ignore[misc]
):
    """Sends the token with every call."""

    def __init__(self, token: str) -> None:
        self._metadata = [("authorization", f"Bearer {token}")]

    def _intercept(self, continuation: Any, details: Any, request: Any) -> Any:
        return continuation(_CallDetails(details, self._metadata), request)

    intercept_unary_unary = _intercept
    intercept_unary_stream = _intercept
    intercept_stream_stream = _intercept
