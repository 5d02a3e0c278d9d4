"""Checks the Kubernetes manifests against Kubernetes' own schemas, and checks the references between manifests, which no
schema covers: names, labels, ports, secrets, addresses and policies. See scripts/check-manifests."""

import argparse
import json
import re
import shutil
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path

import kubernetes_validate
import yaml

ROOT = Path(__file__).resolve().parent.parent
WORKLOADS = ("Deployment", "StatefulSet", "Job")
# The secrets that docs/cluster.md describes.
SECRETS = {"tandem-secrets": {"token", "redis-password"}}
# A pod that someone else starts to call the services that it may call, see deploy/kubernetes/base/network.yaml.
OPERATOR = {"metadata": {"name": "operator"}, "spec": {"template": {"metadata": {"labels": {"tandem-operator": "true"}}}}}
OPERATOR_CALLS = [("learner", 7000), ("bridge", 7002)]
# Limits of failures per index of a Job are enabled since 1.29.
VERSIONS = ("1.29.0", "1.37.0")


# Kustomizations, limited to the features used here. If kubectl or kustomize is installed, its output must be the same.

def documents(path):
    return [document for document in yaml.safe_load_all(path.read_text()) if document]


def build(folder):
    """Returns the objects of a kustomization. Unknown keys are errors."""
    file = folder / "kustomization.yaml"
    kustomization = documents(file)[0]
    known = {"apiVersion", "kind", "namespace", "resources", "configMapGenerator", "generatorOptions", "images", "replicas", "patches"}
    assert set(kustomization) <= known, f"{file}: {set(kustomization) - known} is not known to this check"
    objects = []
    for resource in kustomization.get("resources", []):
        path = folder / resource
        assert path.exists(), f"{file}: there is no {resource}"
        objects += build(path) if path.is_dir() else documents(path)
    for generated in kustomization.get("configMapGenerator", []):
        data = {name: (folder / name).read_text() for name in generated["files"]}
        objects.append({"apiVersion": "v1", "kind": "ConfigMap", "metadata": {"name": generated["name"]}, "data": data})
    for patch in kustomization.get("patches", []):
        for change in documents(folder / patch["path"]):
            key = (change["kind"], change["metadata"]["name"])
            matching = [found for found in objects if (found["kind"], found["metadata"]["name"]) == key]
            assert matching, f"{patch['path']}: nothing to patch is called {key}"
            merge(matching[0], change)
    for found in objects:
        if "namespace" in kustomization:
            found["metadata"]["namespace"] = kustomization["namespace"]
        for image in kustomization.get("images", []):
            for container in containers(found):
                if container["image"].partition(":")[0] == image["name"]:
                    container["image"] = f"{image.get('newName', image['name'])}:{image['newTag']}"
        for replicas in kustomization.get("replicas", []):
            if found["kind"] in WORKLOADS and found["metadata"]["name"] == replicas["name"]:
                found["spec"]["replicas"] = replicas["count"]
    return objects


def merge(base, change):
    for key, value in change.items():
        if isinstance(value, dict):
            merge(base.setdefault(key, {}), value)
        elif isinstance(value, list):
            assert key == "containers", f"a patch of {key} is not known to this check"
            for item in value:
                merge(next(known for known in base[key] if known["name"] == item["name"]), item)
        else:
            base[key] = value


def built_by_others(folder):
    for tool in (["kustomize", "build"], ["kubectl", "kustomize"]):
        if shutil.which(tool[0]):
            built = subprocess.run([*tool, folder], capture_output=True, text=True, check=True).stdout
            return [document for document in yaml.safe_load_all(built) if document]
    return None


def by_key(objects):
    keyed = {(found["kind"], found["metadata"]["name"]): found for found in objects}
    assert len(keyed) == len(objects), "two objects have one name"
    return keyed


# References between objects.

def containers(found):
    return found["spec"]["template"]["spec"]["containers"] if found["kind"] in WORKLOADS else []


def selected(labels, workloads):
    return [w for w in workloads if labels.items() <= w["spec"]["template"]["metadata"]["labels"].items()]


def port_numbers(workload):
    return {port["containerPort"] for container in containers(workload) for port in container.get("ports", [])}


def addresses(container):
    """Returns the services that a container calls, with their ports."""
    texts = container.get("args", []) + [env.get("value", "") for env in container.get("env", [])]
    found = [re.fullmatch(r"(?:[a-z]+://(?:.*@)?)?([a-z][a-z-]*):(\d+)(?:/.*)?", text) for text in texts]
    return [(match[1], int(match[2])) for match in found if match]


class Checked:
    def __init__(self, objects):
        self.problems = []
        self.objects = by_key(objects)
        self.workloads = [found for found in objects if found["kind"] in WORKLOADS]
        self.services = {name: found for (kind, name), found in self.objects.items() if kind == "Service"}
        for found in objects:
            self.expect(found["metadata"].get("namespace") == "tandem", f"{found['kind']} is not in the namespace")
        for workload in self.workloads:
            self.check_workload(workload)
        for service in self.services.values():
            self.check_service(service)
        for found in objects:
            if found["kind"] == "NetworkPolicy":
                self.check_policy(found)
                # The sweep has neither of them.
                if found["metadata"]["name"] == "operator":
                    for host, port in OPERATOR_CALLS:
                        self.check_call(OPERATOR, host, port)
            if found["kind"] == "PodDisruptionBudget":
                self.expect(len(self.selected(found["spec"]["selector"])) == 1, f"budget {found['metadata']['name']} selects no one")

    def expect(self, holds, otherwise):
        if not holds:
            self.problems.append(otherwise)

    def selected(self, selector):
        return selected(selector.get("matchLabels", {}), [*self.workloads, OPERATOR])

    def check_workload(self, workload):
        name, spec = workload["metadata"]["name"], workload["spec"]
        pod = spec["template"]["spec"]
        # The selector of a job is made by the cluster.
        if workload["kind"] == "Job":
            self.check_job(workload)
        else:
            self.expect(self.selected(spec["selector"]) == [workload], f"{name}: its selector does not select its pods alone")
        if workload["kind"] == "StatefulSet":
            governing = self.services.get(spec["serviceName"], {"spec": {}})
            self.expect(governing["spec"].get("clusterIP") == "None", f"{name}: no headless service {spec['serviceName']}")
        self.expect(pod["securityContext"].get("runAsNonRoot") is True, f"{name}: may run as root")
        self.expect(pod["securityContext"].get("seccompProfile") == {"type": "RuntimeDefault"}, f"{name}: no seccomp profile")
        self.expect(pod["terminationGracePeriodSeconds"] >= 30, f"{name}: no time to drain")
        self.expect(pod.get("automountServiceAccountToken") is False, f"{name}: has a service account's token")
        volumes = {volume["name"]: volume for volume in pod.get("volumes", [])}
        claims = {claim["metadata"]["name"] for claim in spec.get("volumeClaimTemplates", [])}
        mounted = set()
        for container in pod["containers"]:
            self.check_container(name, container, workload)
            mounted |= {mount["name"] for mount in container.get("volumeMounts", [])}
        self.expect(mounted == volumes.keys() | claims, f"{name}: mounts {mounted} and has {volumes.keys() | claims}")
        for volume in volumes.values():
            if "secret" in volume:
                keys = {item["key"] for item in volume["secret"]["items"]}
                self.expect(keys <= SECRETS.get(volume["secret"]["secretName"], set()), f"{name}: no secret with {keys}")
            if "persistentVolumeClaim" in volume:
                claim = volume["persistentVolumeClaim"]["claimName"]
                self.expect(("PersistentVolumeClaim", claim) in self.objects, f"{name}: no claim {claim}")
            if "configMap" in volume:
                self.expect(("ConfigMap", volume["configMap"]["name"]) in self.objects, f"{name}: no map {volume['configMap']}")

    def check_job(self, job):
        """Failed pods are replaced, pods that were asked to end are not counted, and a wrong setting ends the job."""
        name, spec = job["metadata"]["name"], job["spec"]
        self.expect(spec["template"]["spec"]["restartPolicy"] == "Never", f"{name}: its exit codes have no rules")
        rules = spec["podFailurePolicy"]["rules"]
        codes = {(rule["action"], code) for rule in rules for code in rule.get("onExitCodes", {}).get("values", [])}
        self.expect(("FailJob", 64) in codes, f"{name}: a wrong setting is tried again")
        named = {rule["onExitCodes"]["containerName"] for rule in rules if "onExitCodes" in rule}
        self.expect(named == {container["name"] for container in containers(job)}, f"{name}: a rule is about no container")
        ignored = [condition["type"] for rule in rules if rule["action"] == "Ignore" for condition in rule.get("onPodConditions", [])]
        self.expect(ignored == ["DisruptionTarget"], f"{name}: evicted pods count as failures")
        if ("ConfigMap", "tandem-sweep") in self.objects:
            self.check_sweep(job)
        else:
            # Without completions, the first pod that succeeds ends the job, so no other end may look like success.
            self.expect("completions" not in spec, f"{name}: waits for a number of pods")
            self.expect(("Ignore", 130) in codes, f"{name}: pods that were asked to end count as failures")
            slots = tomllib.loads(self.objects["ConfigMap", "tandem-run"]["data"]["run.toml"])["rounds"]["slots"]
            self.expect(spec["parallelism"] <= slots, f"{name}: more workers than the run's {slots} slots")

    def check_sweep(self, job):
        """A job has one pod for each run of its sweep file."""
        name, spec = job["metadata"]["name"], job["spec"]
        (text,) = self.objects["ConfigMap", "tandem-sweep"]["data"].values()
        sweep = tomllib.loads(text)
        columns = len(sweep.get("strategies", [])) + len(sweep.get("variant", [])) or 1
        n_runs = columns * len(sweep.get("tasks", [1])) * len(sweep.get("seeds", [1]))
        for axis in sweep.get("axis", []):
            (values,) = axis.values()
            n_runs *= len(values)
        self.expect(spec["completionMode"] == "Indexed", f"{name}: its pods have no index")
        is_per_run = "backoffLimitPerIndex" in spec and not {"backoffLimit", "maxFailedIndexes"} & spec.keys()
        self.expect(is_per_run, f"{name}: a run that fails ends the others")
        self.expect(spec["completions"] == n_runs, f"{name}: {spec['completions']} completions, {n_runs} runs")
        fields = [env.get("valueFrom", {}).get("fieldRef", {}).get("fieldPath") for container in containers(job) for env in container["env"]]
        self.expect("metadata.annotations['batch.kubernetes.io/job-completion-index']" in fields, f"{name}: no pod knows its index")

    def check_container(self, name, container, workload):
        security = container.get("securityContext", {})
        self.expect(security.get("readOnlyRootFilesystem") is True, f"{name}: may write to its root")
        self.expect(security.get("allowPrivilegeEscalation") is False, f"{name}: may gain privileges")
        self.expect(security.get("capabilities") == {"drop": ["ALL"]}, f"{name}: has capabilities")
        resources = container.get("resources", {})
        self.expect({"cpu", "memory"} <= resources.get("requests", {}).keys(), f"{name}: asks for nothing")
        self.expect("memory" in resources.get("limits", {}), f"{name}: has no limit of memory")
        self.expect(":" in container["image"], f"{name}: image {container['image']} has no tag")
        ports = port_numbers(workload)
        listening = [int(arg.removeprefix("0.0.0.0:")) for arg in container["args"] if arg.startswith("0.0.0.0:")]
        for port in listening:
            self.expect(port in ports, f"{name}: listens on {port}, which is not declared")
        for kind in ("startupProbe", "readinessProbe", "livenessProbe"):
            probe = container.get(kind, {})
            for way in ("grpc", "tcpSocket", "httpGet"):
                if way in probe:
                    self.expect(probe[way]["port"] in ports, f"{name}: {kind} asks port {probe[way]['port']}")
            serves = any(port["name"] != "metrics" for port in container.get("ports", []))
            # No service selects the pods of a job, so nothing asks whether they are ready.
            is_optional = kind == "startupProbe" or kind == "readinessProbe" and workload["kind"] == "Job"
            self.expect(is_optional or not serves or probe, f"{name}: has no {kind}")
        scraped = workload["spec"]["template"]["metadata"].get("annotations", {}).get("prometheus.io/port")
        self.expect(scraped is None or int(scraped) in ports, f"{name}: figures are looked for at {scraped}")
        known = set()
        for env in container.get("env", []):
            self.expect(set(re.findall(r"\$\((\w+)\)", env.get("value", ""))) <= known, f"{name}: {env['value'] if 'value' in env else env} comes too early")
            known.add(env["name"])
            secret = env.get("valueFrom", {}).get("secretKeyRef")
            self.expect(secret is None or secret["key"] in SECRETS.get(secret["name"], set()), f"{name}: no secret {secret}")
        self.expect(set(re.findall(r"\$\((\w+)\)", " ".join(container["args"]))) <= known, f"{name}: an argument names an unknown variable")
        if container["command"] == ["/usr/local/bin/tandem"]:
            # All processes of a sweep's pod are on its loopback interface.
            self.expect("TANDEM_TOKEN_FILE" in known or workload["kind"] == "Job", f"{name}: has no token")
        for host, port in addresses(container):
            self.check_call(workload, host, port)

    def check_call(self, caller, host, port):
        name = caller["metadata"]["name"]
        service = self.services.get(host)
        if service is None or port not in {offered["port"] for offered in service["spec"]["ports"]}:
            self.expect(False, f"{name}: calls {host}:{port}, which is no service")
            return
        for called in selected(service["spec"]["selector"], self.workloads):
            self.expect(self.may_pass("Egress", caller, called, port), f"{name}: no policy lets it call {host}:{port}")
            self.expect(self.may_pass("Ingress", called, caller, port), f"{host}: no policy lets {name} in at {port}")

    def may_pass(self, direction, of, peer, port):
        policies = [found for (kind, _), found in self.objects.items() if kind == "NetworkPolicy"]
        rules = [rule for policy in policies if of in self.selected(policy["spec"]["podSelector"])
                 for rule in policy["spec"].get(direction.lower(), [])]
        side = {"Egress": "to", "Ingress": "from"}[direction]
        return any(peer in self.selected(allowed.get("podSelector", {"matchLabels": {"none": ""}}))
                   and "namespaceSelector" not in allowed and port in {p["port"] for p in rule["ports"]}
                   for rule in rules for allowed in rule[side])

    def check_service(self, service):
        name, spec = service["metadata"]["name"], service["spec"]
        behind = selected(spec["selector"], self.workloads)
        self.expect(len(behind) == 1, f"service {name} leads to {len(behind)} workloads")
        offered = {p["name"]: p["containerPort"] for w in behind for c in containers(w) for p in c.get("ports", [])}
        for port in spec["ports"]:
            self.expect(port["targetPort"] in offered, f"service {name}: no container offers {port['targetPort']}")
            # A headless service resolves to pods, so its ports must be those of the pods.
            same = offered.get(port["targetPort"]) == port["port"]
            self.expect(same or spec.get("clusterIP") != "None", f"service {name}: {port['port']} is not the pod's port")

    def check_policy(self, policy):
        name, spec = policy["metadata"]["name"], policy["spec"]
        of = self.selected(spec["podSelector"])
        self.expect(of, f"policy {name} selects no one")
        for rule in spec.get("ingress", []):
            for port in rule["ports"]:
                self.expect(any(port["port"] in port_numbers(w) for w in of), f"policy {name}: no container listens on {port['port']}")


# The complete check.

def commands(objects):
    fields = ("command", "args", "env", "ports", "startupProbe", "readinessProbe", "livenessProbe", "volumeMounts")
    return {(w["metadata"]["name"], c["name"]): {f: c.get(f) for f in fields} for w in objects if w["kind"] in WORKLOADS for c in containers(w)}


def check_files(folder):
    """Checks that every file is used and that the documentation agrees with the manifests."""
    used = set()
    for file in folder.rglob("kustomization.yaml"):
        kustomization = documents(file)[0]
        named = kustomization.get("resources", []) + [patch["path"] for patch in kustomization.get("patches", [])]
        used |= {file} | {(file.parent / name).resolve() for name in named}
    problems = [f"{file.relative_to(folder)} belongs to no kustomization" for file in folder.rglob("*.yaml") if file not in used]
    manual = " ".join((ROOT / "docs/cluster.md").read_text().split())
    for secret, keys in SECRETS.items():
        command = re.search(rf"create secret generic {secret}[^`]*", manual)
        problems += [f"docs/cluster.md makes no {secret} with {key}" for key in keys if not command or f"={key}" not in command[0]]
    version = tomllib.loads((ROOT / "Cargo.toml").read_text())["workspace"]["package"]["version"]
    for file in sorted(folder.rglob("kustomization.yaml")):
        tags = {image["newTag"] for image in documents(file)[0].get("images", [])}
        problems += [f"{file.parent.name}: the image is of version {tag}, the program of {version}" for tag in tags - {version}]
    run = tomllib.loads((folder / "base/run.toml").read_text())
    policies = re.findall(r"/usr/share/tandem/(\S+)", (folder / "base/teacher.yaml").read_text())
    problems += [f"{policy} does not ship" for policy in policies if not (ROOT / policy).is_file()]
    # Policies of the default world have names without it.
    task = run["task"].removeprefix("shared-")
    problems += [f"{policy} knows another task" for policy in policies if f"teacher-{task}." not in policy]
    return problems


def overlays(folder):
    return [*sorted(file.parent for file in (folder / "overlays").glob("*/kustomization.yaml")), folder / "sweep"]


def problems_of(folder):
    problems, base = check_files(folder), commands(build(folder / "base"))
    for overlay in overlays(folder):
        objects = build(overlay)
        problems += [f"{overlay.name}: {problem}" for problem in Checked(objects).problems]
        if overlay.name != "sweep" and commands(objects) != base:
            problems.append(f"{overlay.name} changes commands, which the tests take from the base")
    return problems


def check_schemas(folder):
    for overlay in overlays(folder):
        objects = build(overlay)
        others = built_by_others(overlay)
        if others is not None:
            assert by_key(others) == by_key(objects), f"{overlay.name}: kustomize builds something else"
        for found in objects:
            for version in VERSIONS:
                # Without YAML aliases and tuples, as an API server receives it.
                kubernetes_validate.validate(json.loads(json.dumps(found)), version, strict=True)
        how = ", as kustomize builds them" if others is not None else ""
        print(f"{overlay.name}: {len(objects)} objects fit the schemas of Kubernetes {' and '.join(VERSIONS)}{how}")
    if not any(map(shutil.which, ("kustomize", "kubectl"))):
        text = "manifests as kustomize builds them: neither kustomize nor kubectl is installed"
        subprocess.run([ROOT / "scripts/skip", "KUSTOMIZE", text], check=True)


# Mistakes that no schema detects.
MISTAKES = [
    ("base/learner.yaml", "teacher:7001", "teachers:7001"),
    ("base/learner.yaml", "teacher:7001", "teacher:7002"),
    ("base/learner.yaml", "0.0.0.0:9400", "0.0.0.0:9401"),
    ("base/learner.yaml", "secretName: tandem-secrets", "secretName: tandem-secret"),
    ("base/learner.yaml", "name: tandem-run", "name: tandem-runs"),
    ("base/learner.yaml", "serviceName: learner", "serviceName: learners"),
    ("base/learner.yaml", "port: 7000\n              service", "port: 7007\n              service"),
    ("base/learner.yaml", 'prometheus.io/port: "9400"', 'prometheus.io/port: "9100"'),
    ("base/teacher.yaml", "key: redis-password", "key: password"),
    ("base/teacher.yaml", "- name: REDIS_PASSWORD", "- name: REDIS_PASS"),
    ("base/teacher.yaml", "targetPort: grpc", "targetPort: http"),
    ("base/teacher.yaml", "teacher-push", "teacher-pull"),
    ("base/teacher.yaml", "readOnlyRootFilesystem: true", "readOnlyRootFilesystem: false"),
    ("base/worker.yaml", "mountPath: /run/secrets/tandem", "mountPath: /run/secrets/tandem\n            - name: more\n              mountPath: /more"),
    ("base/worker.yaml", "component: worker", "component: workers"),
    ("base/redis.yaml", "clusterIP: None", "clusterIP: \"\""),
    ("base/network.yaml", "- port: 6379", "- port: 6378"),
    ("base/network.yaml", "app.kubernetes.io/component: bridge", "app.kubernetes.io/component: bridges"),
    ("base/network.yaml", "- port: 7002\n---\n# Pods of", "- port: 7003\n---\n# Pods of"),
    ("base/kustomization.yaml", "newTag: 0.1.0", "newTag: 0.0.9"),
    ("base/kustomization.yaml", "  - redis.yaml\n", ""),
    ("base/run.toml", "slots = 16", "slots = 4"),
    ("sweep/kustomization.yaml", "newTag: 0.1.0", "newTag: 0.0.9"),
    ("sweep/sweep.yaml", "backoffLimitPerIndex: 10", "backoffLimit: 10"),
    ("sweep/sweep.toml", "seeds = [1, 2, 3]", "seeds = [1, 2]"),
    ("sweep/sweep.yaml", "completionMode: Indexed", "completionMode: NonIndexed"),
    ("sweep/sweep.yaml", "job-completion-index", "completion-index"),
    ("sweep/sweep.yaml", "claimName: sweep", "claimName: sweeps"),
    ("sweep/sweep.yaml", "- name: RUN_INDEX", "- name: INDEX"),
    ("base/worker.yaml", "values: [64]", "values: [65]"),
    ("base/worker.yaml", "values: [130]", "values: [0]"),
    ("base/worker.yaml", "  parallelism: 2", "  parallelism: 2\n  completions: 2"),
    ("base/worker.yaml", "restartPolicy: Never", "restartPolicy: OnFailure"),
    ("base/worker.yaml", "containerName: worker", "containerName: workers"),
    ("overlays/cluster/large.yaml", "parallelism: 8", "parallelism: 17"),
    ("overlays/cluster/disruptions.yaml", "app.kubernetes.io/component: teacher", "app.kubernetes.io/component: teachers"),
    ("overlays/cluster/kustomization.yaml", "namespace: tandem\n", ""),
    ("overlays/one-node/small.yaml", "resources:", "args: [learner]\n          resources:"),
]


def check_the_check(folder):
    for file, right, wrong in MISTAKES:
        with tempfile.TemporaryDirectory() as place:
            copied = Path(place).resolve() / "kubernetes"
            shutil.copytree(folder, copied)
            text = (copied / file).read_text()
            assert right in text, f"{file} does not hold {right!r}"
            (copied / file).write_text(text.replace(right, wrong))
            try:
                noticed = problems_of(copied)
            except AssertionError as error:
                noticed = [error]
            assert noticed, f"{file}: {wrong!r} in place of {right!r} goes unnoticed"
    print(f"each of {len(MISTAKES)} mistakes would be noticed")


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, nargs="?", default=ROOT / "deploy/kubernetes")
    folder = parser.parse_args().folder.resolve()
    problems = problems_of(folder)
    for problem in problems:
        print(problem, file=sys.stderr)
    if problems:
        sys.exit(1)
    check_schemas(folder)
    check_the_check(folder)


if __name__ == "__main__":
    main()
