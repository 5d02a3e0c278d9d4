#!/usr/bin/env python3
"""Measures a grpcio echo service with messages of a teacher's size: the overhead of a service in Python.

Usage: python scripts/bench_grpc_echo.py [--rounds 3]     run it after `tandem bench teacher`, on the same machine
Requires: pip install grpcio. Client and server are separate processes. The messages are not decoded.
Prints one JSON object per line (name, value, unit), the best of the rounds, for grpcio's server with threads and with
asyncio. A request asks about two steps of two arms.
"""

import argparse
import asyncio
import concurrent.futures
import json
import queue
import subprocess
import sys
import time

import grpc

REQUEST, ANSWER = bytes(587), bytes(215)
STEPS_PER_REQUEST = 2
SECONDS = 1.0
N_STREAMS = 16


def handlers(unary, stream):
    calls = {"Unary": grpc.unary_unary_rpc_method_handler(unary), "Stream": grpc.stream_stream_rpc_method_handler(stream)}
    return (grpc.method_handlers_generic_handler("Echo", calls),)


def serve_with_threads():
    def stream(requests, _context):
        for _ in requests:
            yield ANSWER

    server = grpc.server(concurrent.futures.ThreadPoolExecutor(max_workers=2 * N_STREAMS))
    server.add_generic_rpc_handlers(handlers(lambda _request, _context: ANSWER, stream))
    print(server.add_insecure_port("127.0.0.1:0"), flush=True)
    server.start()
    sys.stdin.read()


async def serve_with_asyncio():
    async def unary(_request, _context):
        return ANSWER

    async def stream(requests, _context):
        async for _ in requests:
            yield ANSWER

    server = grpc.aio.server()
    server.add_generic_rpc_handlers(handlers(unary, stream))
    print(server.add_insecure_port("127.0.0.1:0"), flush=True)
    await server.start()
    await asyncio.get_running_loop().run_in_executor(None, sys.stdin.read)


def timed(ask):
    """Returns p50 and p99 of `ask`, in microseconds."""
    times, end = [], time.perf_counter() + SECONDS
    while (start := time.perf_counter()) < end:
        ask()
        times.append(1e6 * (time.perf_counter() - start))
    times.sort()
    return times[len(times) // 2], times[len(times) * 99 // 100]


def one_client(address):
    with grpc.insecure_channel(address) as channel:
        unary = channel.unary_unary("/Echo/Unary")
        unary_times = timed(lambda: unary(REQUEST))
        requests = queue.Queue(1)
        answers = channel.stream_stream("/Echo/Stream")(iter(requests.get, None))

        def ask():
            requests.put(REQUEST)
            next(answers)

        stream_times = timed(ask)
        requests.put(None)
        list(answers)
    return unary_times, stream_times


async def many_streams(address):
    """Returns steps per second over streams with one request in flight each."""

    async def one():
        async with grpc.aio.insecure_channel(address, options=[("grpc.use_local_subchannel_pool", 1)]) as channel:
            call, n_requests = channel.stream_stream("/Echo/Stream")(), 0
            while time.perf_counter() < end:
                await call.write(REQUEST)
                await call.read()
                n_requests += 1
            await call.done_writing()
        return n_requests

    start = time.perf_counter()
    end = start + SECONDS
    n_requests = sum(await asyncio.gather(*(one() for _ in range(N_STREAMS))))
    return STEPS_PER_REQUEST * n_requests / (time.perf_counter() - start)


def measure(server, rounds):
    figures = {}

    def note(name, value, unit, better):
        figures[name] = (better(value, figures.get(name, (value,))[0]), unit)

    with subprocess.Popen([sys.executable, __file__, "--serve", server], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        address = f"127.0.0.1:{int(process.stdout.readline())}"
        for _ in range(rounds):
            for call, (p50, p99) in zip(("unary", "stream"), one_client(address)):
                note(f"{call}/p50", p50, "us", min)
                note(f"{call}/p99", p99, "us", min)
            note(f"{N_STREAMS}-streams", asyncio.run(many_streams(address)), "steps/s", max)
        process.stdin.close()
    for name, (value, unit) in figures.items():
        print(json.dumps({"name": f"grpcio-echo/{server}/{name}", "value": round(value, 2), "unit": unit}))


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--rounds", type=int, default=3, help="number of measurements of each server [%(default)s]")
    parser.add_argument("--serve", choices=["threads", "asyncio"], help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.serve == "threads":
        serve_with_threads()
    elif arguments.serve == "asyncio":
        asyncio.run(serve_with_asyncio())
    else:
        for server in ("threads", "asyncio"):
            measure(server, arguments.rounds)


if __name__ == "__main__":
    main()
