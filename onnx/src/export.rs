//! Models of a policy's networks.
//!
//! A model normalises and clips its inputs itself, takes batches of any size, and needs an ONNX runtime of 2021 or
//! later (IR version 7, operators of version 13).

use prost::Message as _;
use tandem_policy::normalizer::CLIP;
use tandem_policy::{Error, MlpShape, NormalizerSnapshot, Policy};

use crate::metadata;
use crate::onnx_proto::{
    AttributeProto, DimensionProto, FLOAT, GraphProto, ModelProto, NodeProto, OperatorSetIdProto,
    StringStringEntryProto, TensorProto, TensorShapeProto, TensorTypeProto, TypeProto,
    ValueInfoProto,
};

/// Version of the file format: that of ONNX 1.8.
const IR_VERSION: i64 = 7;
/// Version of the operators: that of ONNX 1.8.
const OPSET: i64 = 13;
/// Name of the dynamic dimension.
const BATCH: &str = "batch";
/// `AttributeProto.AttributeType.INT`.
const INT: i32 = 2;

/// Encodes the actor of `policy`: inputs `observation`, shape `[batch, n_observation]`, and `goal`, shape
/// `[batch, n_goal]`; output `action`, shape `[batch, n_action]`, in [−1, 1].
///
/// # Errors
/// When the policy is invalid; see [`Policy::check`].
pub fn actor(policy: &Policy) -> Result<Vec<u8>, Error> {
    policy.check()?;
    let mut graph = Graph::new("actor");
    let state = [graph.observation(policy), graph.goal(policy)];
    let input = graph.concat(&state);
    let raw = graph.network(&policy.actor_shape(), &policy.actor, input);
    graph.node("Tanh", &[&raw], "action", &[]);
    graph.add_output("action", policy.task.n_action());
    Ok(graph.into_file(policy))
}

/// Encodes the critic of `policy`: inputs as for [`actor`] and `action`, shape `[batch, n_action]`, in [−1, 1]; output
/// `value`, shape `[batch, n_heads]`.
///
/// # Errors
/// When the policy is invalid; see [`Policy::check`].
pub fn critic(policy: &Policy) -> Result<Vec<u8>, Error> {
    policy.check()?;
    let mut graph = Graph::new("critic");
    let mut inputs = vec![graph.observation(policy), graph.goal(policy)];
    graph.add_input("action", policy.task.n_action());
    inputs.push("action".to_owned());
    let input = graph.concat(&inputs);
    let raw = graph.network(&policy.critic_shape(), &policy.critic, input);
    graph.node("Identity", &[&raw], "value", &[]);
    graph.add_output("value", policy.n_heads);
    Ok(graph.into_file(policy))
}

/// A graph under construction. Values have the names of the nodes that compute them.
struct Graph(GraphProto);

impl Graph {
    fn new(name: &str) -> Self {
        Self(GraphProto { name: name.to_owned(), ..GraphProto::default() })
    }

    fn observation(&mut self, policy: &Policy) -> String {
        self.normalized("observation", &policy.observation_normalizer)
    }

    fn goal(&mut self, policy: &Policy) -> String {
        self.normalized("goal", &policy.goal_normalizer)
    }

    /// Adds the input `name` and its normalisation, and returns the name of the result.
    fn normalized(&mut self, name: &str, normalizer: &NormalizerSnapshot) -> String {
        let size = normalizer.mean.len();
        self.add_input(name, size);
        let mean = self.add_tensor(format!("{name}_mean"), &[size], &normalizer.mean);
        let std = self.add_tensor(format!("{name}_std"), &[size], &normalizer.std);
        if self.0.initializer.iter().all(|tensor| tensor.name != "clip_high") {
            self.add_tensor("clip_low".to_owned(), &[], &[-CLIP]);
            self.add_tensor("clip_high".to_owned(), &[], &[CLIP]);
        }
        let centred = self.node("Sub", &[name, &mean], &format!("{name}_centred"), &[]);
        let scaled = self.node("Div", &[&centred, &std], &format!("{name}_scaled"), &[]);
        let clipped = format!("{name}_normalized");
        self.node("Clip", &[&scaled, "clip_low", "clip_high"], &clipped, &[])
    }

    fn concat(&mut self, values: &[String]) -> String {
        let values: Vec<&str> = values.iter().map(String::as_str).collect();
        self.node("Concat", &values, "state", &[("axis", 1)])
    }

    /// Adds the layers of a network with ReLU between them, and returns the name of the last layer's output.
    fn network(&mut self, shape: &MlpShape, parameters: &[f32], input: String) -> String {
        let mut value = input;
        for layer in 0..shape.n_layers() {
            let (n_out, n_in) = (shape.layer_output(layer), shape.layer_input(layer));
            let weight = &parameters[shape.weight(layer)];
            let weight = self.add_tensor(format!("layer{layer}_weight"), &[n_out, n_in], weight);
            let bias = &parameters[shape.bias(layer)];
            let bias = self.add_tensor(format!("layer{layer}_bias"), &[n_out], bias);
            let inputs = [value.as_str(), &weight, &bias];
            value = self.node("Gemm", &inputs, &format!("layer{layer}"), &[("transB", 1)]);
            if layer < shape.n_hidden_layers {
                value = self.node("Relu", &[&value], &format!("hidden{layer}"), &[]);
            }
        }
        value
    }

    /// Adds a node with one output of the same name, and returns the name.
    fn node(&mut self, op: &str, inputs: &[&str], name: &str, ints: &[(&str, i64)]) -> String {
        let attribute = |(name, i): &(&str, i64)| AttributeProto {
            name: (*name).to_owned(),
            i: *i,
            r#type: INT,
            ..AttributeProto::default()
        };
        self.0.node.push(NodeProto {
            input: inputs.iter().map(|input| (*input).to_owned()).collect(),
            output: vec![name.to_owned()],
            name: name.to_owned(),
            op_type: op.to_owned(),
            attribute: ints.iter().map(attribute).collect(),
            domain: String::new(),
        });
        name.to_owned()
    }

    fn add_tensor(&mut self, name: String, shape: &[usize], numbers: &[f32]) -> String {
        self.0.initializer.push(TensorProto {
            dims: shape.iter().map(|size| dimension(*size)).collect(),
            data_type: FLOAT,
            name: name.clone(),
            raw_data: numbers.iter().flat_map(|number| number.to_le_bytes()).collect(),
            ..TensorProto::default()
        });
        name
    }

    fn add_input(&mut self, name: &str, width: usize) {
        self.0.input.push(value_info(name, width));
    }

    fn add_output(&mut self, name: &str, width: usize) {
        self.0.output.push(value_info(name, width));
    }

    fn into_file(self, policy: &Policy) -> Vec<u8> {
        let metadata = metadata::of(policy).into_iter();
        let model = ModelProto {
            ir_version: IR_VERSION,
            producer_name: "tandem".to_owned(),
            producer_version: env!("CARGO_PKG_VERSION").to_owned(),
            doc_string: String::new(),
            graph: Some(self.0),
            opset_import: vec![OperatorSetIdProto { domain: String::new(), version: OPSET }],
            metadata_props: metadata
                .map(|(key, value)| StringStringEntryProto { key, value })
                .collect(),
        };
        model.encode_to_vec()
    }
}

/// Describes rows of `width` float32 numbers.
fn value_info(name: &str, width: usize) -> ValueInfoProto {
    let batch = DimensionProto { dim_value: None, dim_param: Some(BATCH.to_owned()) };
    let width = DimensionProto { dim_value: Some(dimension(width)), dim_param: None };
    let shape = TensorShapeProto { dim: vec![batch, width] };
    let tensor = TensorTypeProto { elem_type: FLOAT, shape: Some(shape) };
    let r#type = TypeProto { tensor_type: Some(tensor) };
    ValueInfoProto { name: name.to_owned(), r#type: Some(r#type) }
}

fn dimension(size: usize) -> i64 {
    i64::try_from(size).expect("a network has fewer than 2^63 units")
}
