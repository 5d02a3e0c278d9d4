"""Clients of the built program's services."""

import contextlib
import pickle
import shutil
import subprocess
import threading
import time

import pytest

pytest.importorskip("grpc")

import numpy as np
import tandem
from services import ROOT, program, service
from tandem._grpc import Server
from tandem._proto import bridge_pb2, bridge_pb2_grpc

POLICY = str(ROOT / "policies/teacher-push-classic.safetensors")
HOME = (tandem.WayPoint((-0.10, 0.02, 0.12)), tandem.WayPoint((0.10, -0.02, 0.12)))
BUSY = {"late", "owner-silent", "state-old", "state-stale", "command-lost", "drive-fault"}
"""Reasons for which a busy machine may stop the arms."""
N_ATTEMPTS = 20
"""More than a busy machine needs."""


def test_a_teacher_answers_and_its_refusals_are_errors():
    with (
        service("teacher", "--ledger", "memory", "--policy", POLICY) as address,
        tandem.Teacher(address) as teacher,
    ):
        assert teacher.describe().task == "push"
        account = teacher.open_account("mine", budget=3, strategy="ea")
        assert (account.spent, account.left) == (0, 3)
        step = tandem.Step(0, 0, np.zeros(28), np.zeros(3), np.zeros(3))
        (advice,) = teacher.advise("mine", [step])
        assert advice.charged and advice.action.shape == (3,)
        assert np.array_equal(advice.action, advice.arms[0].teacher_action)
        assert teacher.account("mine").left == 2
        with pytest.raises(tandem.CallError, match="steps\\[0\\].goal") as raised:
            teacher.advise("mine", [tandem.Step(0, 1, np.zeros(28), np.zeros(4), np.zeros(3))])
        assert raised.value.code == "INVALID_ARGUMENT" and not raised.value.is_temporary


def test_nothing_that_answers_is_an_error_within_the_timeout():
    with (
        tandem.Teacher("127.0.0.1:1", timeout_s=0.3) as teacher,
        pytest.raises(tandem.CallError, match="no answer within 0.3 s: .*Connection refused") as raised,
    ):
        teacher.describe()
    assert raised.value.is_temporary
    with (
        tandem.Learner("127.0.0.1:1", timeout_s=0.3) as learner,
        pytest.raises(tandem.CallError, match="no answer within 0.3 s"),
    ):
        next(learner.watch())


def test_a_run_directory_leads_to_its_learner(tmp_path):
    run = tmp_path / "run"
    with pytest.raises(tandem.ServiceError, match="run' is not an address: expected HOST:PORT, or a run directory"):
        tandem.Learner(str(run))
    with pytest.raises(tandem.ServiceError, match="holds no run"):
        tandem.Learner(tmp_path)
    command = [program(), "train", "--quiet", "--no-dashboard", "--arms", "1", "--workers", "1", "--out", str(run)]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        deadline = time.monotonic() + 60
        while not (run / "in-use" / "learner").exists():
            assert process.poll() is None and time.monotonic() < deadline
            time.sleep(0.05)
        with tandem.Learner(run) as learner:
            assert learner.status().task in ("", "shared-push"), "none until the learner has its settings"
    finally:
        process.kill()
        process.wait()
    assert (run / "in-use" / "learner").exists(), "a killed run leaves the address"
    with pytest.raises(tandem.ServiceError, match="no learner of a `tandem train` is running in .*run"):
        tandem.Learner(run)


def unless_busy(error):
    """Raises an error of a motion that a busy machine does not explain."""
    is_stopped = isinstance(error, tandem.MotionStopped)
    # Arms that were stopped before a motion starts refuse it, and arms that report a fault refuse a reset.
    refusals = ("not idle but Stopped", "stopped meanwhile", "good states", "a drive reports a fault")
    if not (error.name in BUSY if is_stopped else any(refusal in str(error) for refusal in refusals)):
        raise error


def test_a_motion_is_played_to_its_end():
    with service("bridge", "--driver", "sim") as address, tandem.Bridge(address) as bridge:
        assert bridge.describe().driver == "sim"
        for _ in range(N_ATTEMPTS):
            try:
                with bridge.lease() as lease:
                    lease.reset()
                    lease.reset()  # Idle arms stay as they are.
                    last = lease.move([HOME], speed=1.0)
                break
            except tandem.ServiceError as error:
                unless_busy(error)
        else:
            pytest.fail("no attempt moved the arms to the end")
        assert last.played_s == pytest.approx(last.duration_s)
        for arm, way_point in zip(bridge.status().arms, HOME):
            assert np.allclose(arm.tool_in_world_m, way_point.tool_m, atol=0.01)


def test_a_motion_that_the_check_refuses_raises_an_error():
    with service("bridge", "--driver", "sim") as address, tandem.Bridge(address) as bridge, bridge.lease() as lease:
        below_table = (tandem.WayPoint((-0.1, 0.0, -0.5)), tandem.WayPoint((0.1, 0.0, -0.5)))
        for _ in range(N_ATTEMPTS):
            with pytest.raises(tandem.ServiceError) as raised:
                lease.reset()
                lease.move([below_table], speed=1.0)
            if "the motion is refused" in str(raised.value):
                break
            unless_busy(raised.value)
        else:
            pytest.fail("no attempt moved the arms to the end")


def test_a_stop_ends_a_motion_with_its_reason():
    with service("bridge", "--driver", "sim") as address, tandem.Bridge(address) as bridge, bridge.lease() as lease:
        for _ in range(N_ATTEMPTS):
            # A busy machine may stop the arms before the motion starts, which is then refused.
            with pytest.raises((tandem.MotionStopped, tandem.CallError)) as raised:
                lease.reset()
                for _ in lease.play(tandem.clients.motion([HOME], speed=0.1)):
                    bridge.stop()
            if isinstance(raised.value, tandem.MotionStopped) and raised.value.name == "requested":
                break
        else:
            pytest.fail("no attempt moved the arms to the end")
        assert bridge.status().HasField("stopped")


def test_an_injected_fault_is_present_until_it_is_cleared():
    with service("bridge", "--driver", "sim") as address, tandem.Bridge(address) as bridge:
        (fault,) = bridge.inject("blocked-joint", arm=1, joint=2)
        assert (fault.arm, fault.joint) == (1, 1) and list(bridge.status().injected) == [fault]
        with pytest.raises(ValueError, match="expected one of emergency-stop, drive-fault"):
            bridge.inject("unspecified")
        with pytest.raises(tandem.CallError, match="joint") as raised:
            bridge.inject("torque", joint=9)
        assert raised.value.code == "INVALID_ARGUMENT"
        assert bridge.clear() == [] and not bridge.status().injected


class HungBridge(bridge_pb2_grpc.BridgeServicer):
    """A bridge that sends one report of a motion and answers nothing else."""

    def __init__(self):
        self.ended = threading.Event()

    def Acquire(self, request, context):
        return bridge_pb2.AcquireResponse(token="token")

    def Release(self, request, context):
        return bridge_pb2.ReleaseResponse()

    def Execute(self, requests, context):
        yield bridge_pb2.ExecuteResponse(progress=bridge_pb2.MotionProgress(played_s=0.1))
        self.ended.wait()

    def Stop(self, request, context):
        self.ended.wait()
        return bridge_pb2.StopResponse()


@contextlib.contextmanager
def hung_bridge():
    """Yields a client of a bridge that hangs."""
    servicer = HungBridge()

    def add(server):
        bridge_pb2_grpc.add_BridgeServicer_to_server(servicer, server)

    with Server(add, max_streams=1) as server, tandem.Bridge(server.address, timeout_s=60) as bridge:
        try:
            yield bridge
        finally:
            servicer.ended.set()


def test_a_stop_that_is_not_confirmed_names_the_emergency_stop(monkeypatch):
    monkeypatch.setattr(tandem.clients, "_STOP_S", 0.2)
    expected = "the stop is not confirmed, use the emergency stop: no answer within 0.2 s$"
    with hung_bridge() as bridge, pytest.raises(tandem.CallError, match=expected) as raised:
        bridge.stop()
    assert raised.value.code == "DEADLINE_EXCEEDED"


def test_a_stop_without_a_bridge_gives_the_reason():
    expected = "use the emergency stop: no answer within 0.3 s: .*Connection refused"
    with tandem.Bridge("127.0.0.1:1", timeout_s=0.3) as bridge, pytest.raises(tandem.CallError, match=expected):
        bridge.stop()

    def act(observation, goal):
        return np.zeros((len(observation), 3))

    expected = "use the emergency stop: the service does not know the call"
    with tandem.PolicyServer(act, task="push") as server, tandem.Bridge(server.address) as bridge:
        with pytest.raises(tandem.CallError, match=expected) as raised:
            bridge.stop()
    assert raised.value.code == "UNIMPLEMENTED"


def test_a_motion_without_reports_is_an_error(monkeypatch):
    monkeypatch.setattr(tandem.clients, "_REPORT_S", 0.2)
    with hung_bridge() as bridge, bridge.lease() as lease:
        reports = lease.play(tandem.clients.motion([HOME], speed=1.0))
        assert next(reports).played_s == 0.1
        with pytest.raises(tandem.CallError, match="no report of the motion within 0.2 s; .* emergency stop") as raised:
            next(reports)
    assert raised.value.is_temporary


def test_calls_use_tls_and_the_token(tmp_path):
    if shutil.which("openssl") is None:
        pytest.skip("there is no openssl")
    key, certificate, token = (tmp_path / name for name in ("key.pem", "certificate.pem", "token"))
    token.write_text("0123456789abcdef")
    subprocess.run(
        ["openssl", "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256", "-nodes", "-days", "2"]
        + ["-subj", "/CN=localhost", "-addext", "subjectAltName=DNS:localhost"]
        + ["-addext", "basicConstraints=critical,CA:FALSE"]
        + ["-keyout", str(key), "-out", str(certificate)],
        check=True,
        capture_output=True,
    )
    options = ["--tls-cert", str(certificate), "--tls-key", str(key), "--token-file", str(token)]
    with service("teacher", "--ledger", "memory", "--policy", POLICY, *options) as address:
        address = address.replace("127.0.0.1", "localhost")
        with tandem.Teacher(address, tls_ca=certificate, token_file=token) as teacher:
            assert teacher.describe().task == "push"
        with tandem.Teacher(address, tls_ca=certificate) as teacher:
            with pytest.raises(tandem.CallError) as raised:
                teacher.describe()
            assert raised.value.code == "UNAUTHENTICATED"
        with pytest.raises(tandem.ServiceError, match="requires TLS"):
            tandem.Teacher(f"https://{address}")
        with tandem.Teacher(address, timeout_s=1) as teacher:
            with pytest.raises(tandem.CallError, match="no answer within 1 s: .*; it uses TLS: give tls_ca"):
                teacher.describe()

    def act(observation, goal):
        return np.zeros((len(observation), 3))

    tls = {"tls_cert": certificate, "tls_key": key, "token_file": token}
    client = ["--tls-ca", str(certificate), "--token-file", str(token)]
    with (
        tandem.PolicyServer(act, task="push", listen="localhost:0", **tls) as server,
        service("teacher", "--ledger", "memory", "--policy", server.address, *client) as address,
        tandem.Teacher(address, token_file=token) as teacher,
    ):
        assert teacher.describe().policy_digest == server.digest


def test_the_address_of_another_service_is_named() -> None:
    with service("teacher", "--ledger", "memory", "--policy", POLICY) as address, tandem.Learner(address) as learner:
        with pytest.raises(tandem.CallError, match="the service is teacher, not learner: check the address") as raised:
            learner.watch().__next__()
        assert not raised.value.is_temporary

    def act(observation, goal):
        return np.zeros((len(observation), 3))

    with tandem.PolicyServer(act, task="push") as server, tandem.Teacher(server.address) as teacher:
        with pytest.raises(tandem.CallError, match="does not know the call"):
            teacher.describe()


def test_errors_survive_pickling() -> None:
    """Otherwise a pool of processes would wait for ever for the result of a call that failed."""
    error = pickle.loads(pickle.dumps(tandem.CallError("UNAVAILABLE", "no answer")))
    assert (error.code, error.is_temporary, str(error)) == ("UNAVAILABLE", True, "no answer")
    stopped = pickle.loads(pickle.dumps(tandem.MotionStopped("requested", "a client stopped the arms")))
    assert (stopped.name, str(stopped)) == ("requested", "the arms are stopped: a client stopped the arms")
