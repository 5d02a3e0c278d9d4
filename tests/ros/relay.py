"""A ROS node that implements the part of the rosbridge protocol (version 2) that the driver uses: relay.py PORT, 0 for any port.

Tests use it because only ROS' own distribution packages rosbridge. The behavior that matters to a driver is that of rosbridge_suite for
ROS 1: operations of a client run in sequence, and each service call in its own thread. A publisher is created when it is advertised and
kept. Messages of its first second are repeated to new subscribers in that second. A full subscription queue drops its oldest message, and
without a queue nothing is dropped. Errors are returned as a status. Only services of kinova_msgs are known.
"""

import asyncio
import collections
import importlib
import json
import math
import queue
import sys
import threading
import time

import genpy
import rospy
import websockets
from kinova_msgs.srv import HomeArm, Start, Stop

SERVICES = {"in/stop": Stop, "in/start": Start, "in/home_arm": HomeArm}
EARLY_S = 1.0
publishers = {}


class Publisher(rospy.SubscribeListener):
    """A publisher with the messages of its first second."""

    def __init__(self, topic, kind, queue_size):
        super().__init__()
        self.type, self.early, self.created_s = kind, [], time.monotonic()
        self.topic = rospy.Publisher(topic, kind, subscriber_listener=self, queue_size=queue_size)

    def is_new(self):
        return time.monotonic() < self.created_s + EARLY_S

    def peer_subscribe(self, _topic, _publish, publish_to_peer):
        for message in list(self.early) if self.is_new() else []:
            publish_to_peer(message)

    def publish(self, fields):
        message = self.type()
        genpy.message.fill_message_args(message, [fields])
        if self.is_new():
            self.early.append(message)
        self.topic.publish(message)


class Client:
    """The connection of a client."""

    def __init__(self, socket):
        self.socket = socket
        self.loop = asyncio.get_running_loop()
        self.incoming = queue.Queue()
        self.outgoing = []
        self.subscribed = []

    async def serve(self):
        self.answers = self.sender(0)
        worker = threading.Thread(target=self.work, daemon=True)
        worker.start()
        try:
            async for text in self.socket:
                self.incoming.put(text)
        except websockets.ConnectionClosed:
            pass
        finally:
            # Pending operations are discarded.
            self.incoming.queue.clear()
            self.incoming.put(None)
            for subscriber in self.subscribed:
                subscriber.unregister()
            for task in self.outgoing:
                task.cancel()

    def sender(self, queue_length):
        """Returns a function that queues messages for sending, from any thread."""
        waiting, due = collections.deque(maxlen=queue_length or None), asyncio.Event()

        async def send():
            while True:
                await due.wait()
                due.clear()
                while waiting:
                    await self.socket.send(json.dumps(waiting.popleft(), allow_nan=False))

        def enqueue(message):
            waiting.append(message)
            self.loop.call_soon_threadsafe(due.set)

        self.outgoing.append(asyncio.run_coroutine_threadsafe(send(), self.loop))
        return enqueue

    def work(self):
        operations = {
            "advertise": self.advertise, "subscribe": self.subscribe, "publish": self.publish,
            "call_service": lambda request: threading.Thread(target=self.call, args=[request], daemon=True).start(),
        }
        while (text := self.incoming.get()) is not None:
            try:
                request = json.loads(text)
                operations[request["op"]](request)
            except Exception as error:  # every error is returned to the client
                self.answers({"op": "status", "level": "error", "msg": f"{type(error).__name__}: {error}"})

    def advertise(self, request):
        topic, kind = request["topic"], message_class(request["type"])
        if topic not in publishers:
            publishers[topic] = Publisher(topic, kind, request.get("queue_size", 100))
        if publishers[topic].type is not kind:
            raise TypeError(f"{topic} is of type {publishers[topic].type._type}")

    def subscribe(self, request):
        topic, enqueue = request["topic"], self.sender(request.get("queue_length", 0))
        pause_s, last_sent_s = request.get("throttle_rate", 0) / 1000, -math.inf

        def forward(message):
            nonlocal last_sent_s
            if time.monotonic() >= last_sent_s + pause_s:
                last_sent_s = time.monotonic()
                enqueue({"op": "publish", "topic": topic, "msg": plain(message)})

        self.subscribed.append(rospy.Subscriber(topic, message_class(request["type"]), forward))

    def publish(self, request):
        publishers[request["topic"]].publish(request["msg"])

    def call(self, request):
        service, answer = request["service"], {"op": "service_response", "service": request["service"]}
        if "id" in request:
            answer["id"] = request["id"]
        try:
            kind = next(kind for name, kind in SERVICES.items() if service.endswith(name))
            values = plain(rospy.ServiceProxy(service, kind)())
            answer.update(values=values, result=True)
        except Exception as error:  # the node is gone, the master is gone, the service has failed
            answer.update(values=str(error), result=False)
            self.answers({"op": "status", "level": "error", "msg": f"call_service {type(error).__name__}: {error}"})
        self.answers(answer)


def message_class(name):
    package, name = name.split("/")
    return getattr(importlib.import_module(f"{package}.msg"), name)


def plain(value):
    """Converts a ROS message to JSON values. Numbers that are not finite become null."""
    if isinstance(value, genpy.TVal):
        return {"secs": value.secs, "nsecs": value.nsecs}
    if isinstance(value, genpy.Message):
        return {name: plain(getattr(value, name)) for name in value.__slots__}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


async def main():
    rospy.init_node("rosbridge_websocket", disable_signals=True)
    async with websockets.serve(lambda socket: Client(socket).serve(), "127.0.0.1", int(sys.argv[1]), compression=None) as server:
        print("listening on", server.sockets[0].getsockname()[1], flush=True)
        await asyncio.Future()


if __name__ == "__main__":
    asyncio.run(main())
