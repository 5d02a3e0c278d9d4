"""Connections whose other end hangs."""

import contextlib
import signal
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

pytest.importorskip("grpc")

import grpc
from tandem import _grpc

DEADLINE_S = 30.0
"""More than a busy machine needs, and less than the sixty seconds of gRPC's own limit."""
SERVER = """
import test_grpc, threading
print(test_grpc.serve(threading.Event(), [])[1], flush=True)
threading.Event().wait()
"""
CLIENT = """
import sys, test_grpc, threading
stream = test_grpc.watch(int(sys.argv[1]), [])
print(next(stream), flush=True)
threading.Event().wait()
"""


def shortened(options):
    """Returns options whose time limits are half a second instead of ten."""
    return [(name, 500 if value == 10_000 else value) for name, value in options]


def serve(ended, options):
    """Serves a stream, and sets `ended` when it ends. Returns the server and its port."""

    def watch(_request, context):
        context.add_callback(ended.set)
        yield b"first"
        ended.wait()

    server = grpc.server(ThreadPoolExecutor(1), options=options)
    methods = {"Watch": grpc.unary_stream_rpc_method_handler(watch)}
    server.add_generic_rpc_handlers((grpc.method_handlers_generic_handler("test.Test", methods),))
    port = server.add_insecure_port("127.0.0.1:0")
    server.start()
    return server, port


def watch(port, options):
    channel = grpc.insecure_channel(f"127.0.0.1:{port}", options=options)
    return channel.unary_stream("/test.Test/Watch")(b"")


@contextlib.contextmanager
def other_end(code, *arguments):
    """Runs `code` as a process of its own."""
    command = [sys.executable, "-c", code, *arguments]
    process = subprocess.Popen(command, cwd=Path(__file__).parent, stdout=subprocess.PIPE, text=True)
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def test_a_stream_fails_when_its_server_hangs():
    with other_end(SERVER) as server:
        stream = watch(int(server.stdout.readline()), shortened(_grpc._CHANNEL_OPTIONS))
        assert next(stream) == b"first"
        server.send_signal(signal.SIGSTOP)
        too_late = threading.Timer(DEADLINE_S, stream.cancel)
        too_late.start()
        with pytest.raises(grpc.RpcError) as raised:
            next(stream)
        too_late.cancel()
        assert raised.value.code() is grpc.StatusCode.UNAVAILABLE


def test_a_stream_ends_when_its_client_hangs():
    ended = threading.Event()
    server, port = serve(ended, shortened(_grpc._SERVER_OPTIONS))
    with other_end(CLIENT, str(port)) as client:
        assert client.stdout.readline()
        client.send_signal(signal.SIGSTOP)
        assert ended.wait(DEADLINE_S)
    server.stop(None)
