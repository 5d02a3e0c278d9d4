"""A relay that speaks the part of rosbridge's protocol (version 2) that our driver uses, as a ROS node: relay.py PORT, 0 for any.

It is for tests where rosbridge itself cannot be had: no distribution but ROS' own packages it. What matters to a driver is as in
rosbridge_suite for ROS 1: operations of a client are done one after the other, calls of services each in a thread of its own;
a publisher is made when it is advertised and stays; what it publishes in its first second is given again to whoever subscribes
in that second; a subscription with a queue forgets its oldest message when the queue is full, one without a queue forgets nothing; what
goes wrong is told as a status. Types of services are known for kinova_msgs only.
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
from kinova_msgs.srv import Start, Stop

SERVICES = {"in/stop": Stop, "in/start": Start}
FIRST_S = 1.0
publishers = {}


class Publisher(rospy.SubscribeListener):
    """A publisher, and what it published in its first second."""

    def __init__(self, topic, kind, queue_size):
        super().__init__()
        self.type, self.first, self.made_s = kind, [], time.monotonic()
        self.topic = rospy.Publisher(topic, kind, subscriber_listener=self, queue_size=queue_size)

    def is_new(self):
        return time.monotonic() < self.made_s + FIRST_S

    def peer_subscribe(self, _topic, _publish, publish_to_peer):
        for message in list(self.first) if self.is_new() else []:
            publish_to_peer(message)

    def publish(self, fields):
        message = self.type()
        genpy.message.fill_message_args(message, [fields])
        if self.is_new():
            self.first.append(message)
        self.topic.publish(message)


class Client:
    """A connection."""

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
            # What has not been done by now is not done any more.
            self.incoming.queue.clear()
            self.incoming.put(None)
            for subscriber in self.subscribed:
                subscriber.unregister()
            for task in self.outgoing:
                task.cancel()

    def sender(self, queue_length):
        """Something that sends what it is given, from any thread, by a queue of its own."""
        waiting, due = collections.deque(maxlen=queue_length or None), asyncio.Event()

        async def send():
            while True:
                await due.wait()
                due.clear()
                while waiting:
                    await self.socket.send(json.dumps(waiting.popleft(), allow_nan=False))

        def give(message):
            waiting.append(message)
            self.loop.call_soon_threadsafe(due.set)

        self.outgoing.append(asyncio.run_coroutine_threadsafe(send(), self.loop))
        return give

    def work(self):
        operations = {
            "advertise": self.advertise, "subscribe": self.subscribe, "publish": self.publish,
            "call_service": lambda asked: threading.Thread(target=self.call, args=[asked], daemon=True).start(),
        }
        while (text := self.incoming.get()) is not None:
            try:
                asked = json.loads(text)
                operations[asked["op"]](asked)
            except Exception as error:  # whatever it is, the client is told
                self.answers({"op": "status", "level": "error", "msg": f"{type(error).__name__}: {error}"})

    def advertise(self, asked):
        topic, kind = asked["topic"], message_class(asked["type"])
        if topic not in publishers:
            publishers[topic] = Publisher(topic, kind, asked.get("queue_size", 100))
        if publishers[topic].type is not kind:
            raise TypeError(f"{topic} is of type {publishers[topic].type._type}")

    def subscribe(self, asked):
        topic, give = asked["topic"], self.sender(asked.get("queue_length", 0))
        pause_s, told_s = asked.get("throttle_rate", 0) / 1000, -math.inf

        def tell(message):
            nonlocal told_s
            if time.monotonic() >= told_s + pause_s:
                told_s = time.monotonic()
                give({"op": "publish", "topic": topic, "msg": plain(message)})

        self.subscribed.append(rospy.Subscriber(topic, message_class(asked["type"]), tell))

    def publish(self, asked):
        publishers[asked["topic"]].publish(asked["msg"])

    def call(self, asked):
        service, answer = asked["service"], {"op": "service_response", "service": asked["service"]}
        if "id" in asked:
            answer["id"] = asked["id"]
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
    """A message of ROS as JSON has it. Numbers that are none are null."""
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
