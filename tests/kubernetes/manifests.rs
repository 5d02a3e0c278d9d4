//! The parts of the Kubernetes manifests that are needed to run their containers.

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;

use serde::Deserialize;
use serde::de::DeserializeOwned;
use serde_json::Value;

/// A container of a pod.
#[derive(Debug, Clone, Deserialize)]
#[serde(rename_all = "camelCase")]
pub(crate) struct Container {
    pub(crate) command: Vec<String>,
    pub(crate) args: Vec<String>,
    #[serde(default)]
    pub(crate) env: Vec<Env>,
    #[serde(default)]
    pub(crate) ports: Vec<Port>,
    #[serde(default)]
    pub(crate) volume_mounts: Vec<Mount>,
    pub(crate) startup_probe: Option<Probe>,
    pub(crate) readiness_probe: Option<Probe>,
    pub(crate) liveness_probe: Option<Probe>,
}

impl Container {
    pub(crate) fn probes(&self) -> impl Iterator<Item = &Probe> {
        [&self.startup_probe, &self.readiness_probe, &self.liveness_probe].into_iter().flatten()
    }

    pub(crate) fn has_port(&self, port: u16) -> bool {
        self.ports.iter().any(|declared| declared.container_port == port)
    }
}

#[derive(Debug, Clone, Deserialize)]
#[serde(rename_all = "camelCase")]
pub(crate) struct Env {
    pub(crate) name: String,
    pub(crate) value: Option<String>,
    pub(crate) value_from: Option<ValueFrom>,
}

#[derive(Debug, Clone, Deserialize)]
#[serde(rename_all = "camelCase")]
pub(crate) enum ValueFrom {
    SecretKeyRef {
        name: String,
        key: String,
    },
    #[serde(rename_all = "camelCase")]
    FieldRef {
        field_path: String,
    },
}

#[derive(Debug, Clone, Deserialize)]
#[serde(rename_all = "camelCase")]
pub(crate) struct Port {
    pub(crate) name: String,
    pub(crate) container_port: u16,
}

#[derive(Debug, Clone, Deserialize)]
#[serde(rename_all = "camelCase")]
pub(crate) struct Mount {
    pub(crate) name: String,
    pub(crate) mount_path: String,
}

#[derive(Debug, Clone, Deserialize)]
#[serde(rename_all = "camelCase")]
pub(crate) struct Probe {
    pub(crate) grpc: Option<Grpc>,
    pub(crate) exec: Option<Exec>,
    pub(crate) tcp_socket: Option<TcpSocket>,
}

#[derive(Debug, Clone, Deserialize)]
pub(crate) struct Grpc {
    pub(crate) port: u16,
    #[serde(default)]
    pub(crate) service: String,
}

#[derive(Debug, Clone, Deserialize)]
pub(crate) struct Exec {
    pub(crate) command: Vec<String>,
}

#[derive(Debug, Clone, Deserialize)]
pub(crate) struct TcpSocket {
    pub(crate) port: u16,
}

/// The source of a volume.
#[derive(Debug, Clone)]
pub(crate) enum Source {
    /// Files of a secret: secret name and key by file name.
    Secret(BTreeMap<String, (String, String)>),
    /// The files of a config map.
    ConfigMap(String),
    /// A persistent directory of the pod.
    Claim,
}

/// A Deployment, StatefulSet or Job.
#[derive(Debug, Clone)]
pub(crate) struct Workload {
    pub(crate) replicas: u64,
    /// Pods of an Indexed Job.
    pub(crate) completions: Option<u64>,
    pub(crate) container: Container,
    pub(crate) volumes: BTreeMap<String, Source>,
    labels: Value,
}

/// A service: its workload and the container port of each service port.
#[derive(Debug, Clone)]
pub(crate) struct Service {
    pub(crate) workload: String,
    pub(crate) ports: BTreeMap<u16, u16>,
}

/// A config map of one file.
#[derive(Debug, Clone)]
pub(crate) struct ConfigMap {
    pub(crate) name: String,
    pub(crate) file: String,
    pub(crate) text: String,
}

/// The manifests of a kustomization.
#[derive(Debug, Clone)]
pub(crate) struct Manifests {
    pub(crate) workloads: BTreeMap<String, Workload>,
    pub(crate) services: BTreeMap<String, Service>,
    /// The run file or the sweep file.
    pub(crate) settings: ConfigMap,
}

impl Manifests {
    /// Reads the manifests of a training run. Overlays do not change their commands.
    pub(crate) fn of_base() -> Self {
        Self::read("base")
    }

    pub(crate) fn of_sweep() -> Self {
        Self::read("sweep")
    }

    fn read(folder: &str) -> Self {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("deploy/kubernetes").join(folder);
        let read = |name: &str| fs::read_to_string(folder.join(name)).expect("a file");
        let documents = |name: &str| -> Vec<Value> {
            serde_saphyr::from_multiple(&read(name)).expect("YAML documents")
        };
        let kustomization = documents("kustomization.yaml").swap_remove(0);
        let resources: Vec<String> = at(&kustomization, "/resources");
        let objects: Vec<Value> = resources.iter().flat_map(|name| documents(name)).collect();
        let of_kind = |kinds: &'static [&str]| {
            objects.iter().filter(|object| kinds.contains(&at::<String>(object, "/kind").as_str()))
        };
        let workloads: BTreeMap<String, Workload> = of_kind(&["Deployment", "StatefulSet", "Job"])
            .map(|object| (at(object, "/metadata/name"), workload(object)))
            .collect();
        let services = of_kind(&["Service"])
            .map(|object| (at(object, "/metadata/name"), service(object, &workloads)))
            .collect();
        let file: String = at(&kustomization, "/configMapGenerator/0/files/0");
        let name = at(&kustomization, "/configMapGenerator/0/name");
        let settings = ConfigMap { name, text: read(&file), file };
        Self { workloads, services, settings }
    }
}

fn workload(object: &Value) -> Workload {
    let containers: Vec<Container> = at(object, "/spec/template/spec/containers");
    let [container] = <[Container; 1]>::try_from(containers).expect("one container per pod");
    let spec = object.pointer("/spec").expect("a specification");
    let listed = |list: &str| {
        let list = spec.pointer(list).and_then(Value::as_array).cloned();
        list.unwrap_or_default()
    };
    let mut volumes: BTreeMap<String, Source> = listed("/template/spec/volumes")
        .iter()
        .map(|volume| (at(volume, "/name"), source(volume)))
        .collect();
    let claims = listed("/volumeClaimTemplates");
    volumes.extend(claims.iter().map(|claim| (at(claim, "/metadata/name"), Source::Claim)));
    let replicas = spec.pointer("/replicas").or_else(|| spec.pointer("/parallelism"));
    let replicas = replicas.and_then(Value::as_u64).unwrap_or(1);
    let completions = spec.pointer("/completions").and_then(Value::as_u64);
    let labels = at(object, "/spec/template/metadata/labels");
    Workload { replicas, completions, container, volumes, labels }
}

fn source(volume: &Value) -> Source {
    if let Some(map) = volume.pointer("/configMap/name") {
        return Source::ConfigMap(map.as_str().expect("a name").to_owned());
    }
    if volume.pointer("/persistentVolumeClaim").is_some() {
        return Source::Claim;
    }
    let secret: String = at(volume, "/secret/secretName");
    let items: Vec<BTreeMap<String, String>> = at(volume, "/secret/items");
    let files =
        items.iter().map(|item| (item["path"].clone(), (secret.clone(), item["key"].clone())));
    Source::Secret(files.collect())
}

fn service(object: &Value, workloads: &BTreeMap<String, Workload>) -> Service {
    let selector: BTreeMap<String, String> = at(object, "/spec/selector");
    let is_meant = |workload: &Workload| {
        selector.iter().all(|(label, value)| workload.labels[label].as_str() == Some(value))
    };
    let mut meant = workloads.iter().filter(|(_, workload)| is_meant(workload));
    let (name, workload) = meant.next().expect("a service selects a workload");
    assert!(meant.next().is_none(), "a service selects one workload");
    let ports: Vec<Value> = at(object, "/spec/ports");
    let ports = ports.iter().map(|port| {
        let target: String = at(port, "/targetPort");
        let declared = workload.container.ports.iter().find(|declared| declared.name == target);
        (at(port, "/port"), declared.expect("a declared port").container_port)
    });
    Service { workload: name.clone(), ports: ports.collect() }
}

fn at<T: DeserializeOwned>(object: &Value, pointer: &str) -> T {
    let value = object.pointer(pointer).unwrap_or_else(|| panic!("no {pointer} in {object}"));
    serde_json::from_value(value.clone()).unwrap_or_else(|error| panic!("{pointer}: {error}"))
}
