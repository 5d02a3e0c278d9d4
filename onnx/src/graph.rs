//! From a graph to a [`Network`]: interprets the nodes that the output depends on.
//!
//! Every value of the graph is a constant, rows of input numbers after elementwise operations, or the row after some
//! layer. Nodes combine them as in a multilayer perceptron and in no other way.

mod constant;
mod node;

use std::collections::{BTreeMap, BTreeSet};

use tandem_core::task::MAX_NUMBERS;

use crate::error::ModelError;
use crate::network::{Column, Input, Layer, Network, Op, Step};
use crate::onnx_proto::{FLOAT, GraphProto, NodeProto, ValueInfoProto};
use constant::Constant;

/// Largest accepted number of nodes.
const MAX_NODES: usize = 1024;
/// Largest accepted number of inputs.
const MAX_INPUTS: usize = 16;
/// Largest accepted length of a row of an input: an observation, a goal and an action.
const MAX_INPUT_WIDTH: usize = 3 * MAX_NUMBERS;
/// Largest accepted number of numbers that enter the first layer.
const MAX_COLUMNS: usize = 2 * MAX_INPUT_WIDTH;
/// Memory that the interpretation may take besides four times the size of the file.
const EXTRA_BYTES: usize = 16 << 20;
/// Names that select the output of a model with several.
const OUTPUT_NAMES: [&str; 6] = ["action", "actions", "value", "values", "q", "output"];

/// A value of the graph.
#[derive(Debug, Clone)]
enum Value<'a> {
    Constant(Constant<'a>),
    /// Numbers of the inputs.
    Columns(Vec<Column>),
    /// The row after a step.
    Hidden {
        /// Index of the step.
        step: usize,
        width: usize,
    },
}

/// A step and the step or columns before it.
struct Link {
    before: Before,
    step: Step,
}

enum Before {
    Columns(Vec<Column>),
    Step(usize),
}

/// The interpretation of a graph so far.
struct Interpreter<'a> {
    opset: i64,
    values: BTreeMap<&'a str, Value<'a>>,
    links: Vec<Link>,
    /// Memory that values and steps may still take.
    bytes_left: usize,
    max_bytes: usize,
}

/// Returns the network of a graph with operators of version `opset`, from a file of `n_file_bytes`.
pub(crate) fn network(
    graph: &GraphProto,
    opset: i64,
    n_file_bytes: usize,
) -> Result<Network, ModelError> {
    check_count("nodes", graph.node.len(), MAX_NODES)?;
    let output = output(graph)?;
    let max_bytes = EXTRA_BYTES + 4 * n_file_bytes;
    let mut interpreter = Interpreter {
        opset,
        values: BTreeMap::new(),
        links: Vec::new(),
        bytes_left: max_bytes,
        max_bytes,
    };
    for tensor in &graph.initializer {
        let value = Value::Constant(Constant::new(tensor));
        if interpreter.values.insert(&tensor.name, value).is_some() {
            return Err(ModelError::Tensor {
                tensor: tandem_core::text::shortened(&tensor.name, 80),
                problem: "another initializer has the same name".to_owned(),
            });
        }
    }
    let inputs = interpreter.add_inputs(graph)?;
    let needed = needed_nodes(graph, &output.name)?;
    for (_, node) in graph.node.iter().enumerate().filter(|(idx, _)| needed.contains(idx)) {
        let value = node::interpret(&mut interpreter, node)?;
        let name = node.output.first().map_or("", String::as_str);
        if interpreter.values.insert(name, value).is_some() {
            return Err(node.refused(format!("an input or initializer is named {name:?} too")));
        }
    }
    interpreter.into_network(inputs, &output.name)
}

/// Returns the indices of the nodes that `output` depends on.
fn needed_nodes(graph: &GraphProto, output: &str) -> Result<BTreeSet<usize>, ModelError> {
    let mut producers = BTreeMap::new();
    for (idx, node) in graph.node.iter().enumerate() {
        for name in node.output.iter().filter(|name| !name.is_empty()) {
            if producers.insert(name.as_str(), idx).is_some() {
                return Err(node.refused(format!("an earlier node computes {name:?} too")));
            }
        }
    }
    let mut needed = BTreeSet::new();
    let mut open = vec![output];
    while let Some(name) = open.pop() {
        if let Some(idx) = producers.get(name).copied()
            && needed.insert(idx)
        {
            open.extend(graph.node[idx].input.iter().map(String::as_str));
        }
    }
    Ok(needed)
}

/// Returns the output: the only one, or the first with a name that says what it is.
fn output(graph: &GraphProto) -> Result<&ValueInfoProto, ModelError> {
    if let [output] = graph.output.as_slice() {
        return Ok(output);
    }
    let named = graph.output.iter().find(|output| OUTPUT_NAMES.contains(&output.name.as_str()));
    named.ok_or_else(|| {
        ModelError::Model(format!(
            "it has {} outputs, expected one, or one named {}",
            graph.output.len(),
            OUTPUT_NAMES.join(", ")
        ))
    })
}

fn check_count(what: &'static str, got: usize, most: usize) -> Result<(), ModelError> {
    if got <= most { Ok(()) } else { Err(ModelError::TooLarge { what, got, most }) }
}

/// Returns the length of the rows of an input, whose shape is `[batch, width]`.
fn input_width(input: &ValueInfoProto) -> Result<usize, ModelError> {
    let refused =
        |problem: String| ModelError::Value { kind: "input", name: input.name.clone(), problem };
    let tensor = input.r#type.as_ref().and_then(|r#type| r#type.tensor_type.as_ref());
    let tensor = tensor.ok_or_else(|| refused("it is not a tensor".to_owned()))?;
    if tensor.elem_type != FLOAT {
        return Err(refused(format!("its type is number {}, expected float32", tensor.elem_type)));
    }
    let dimensions = tensor.shape.as_ref().map_or(&[][..], |shape| &shape.dim);
    let width = match dimensions {
        [_, width] => width.dim_value.and_then(|width| usize::try_from(width).ok()),
        _ => None,
    };
    width.filter(|width| (1..=MAX_INPUT_WIDTH).contains(width)).ok_or_else(|| {
        refused(format!("expected shape [batch, n] with n from 1 to {MAX_INPUT_WIDTH}"))
    })
}

fn another_input(name: &str) -> ModelError {
    ModelError::Value {
        kind: "input",
        name: tandem_core::text::shortened(name, 80),
        problem: "another input has the same name".to_owned(),
    }
}

impl<'a> Interpreter<'a> {
    /// Adds the inputs. Initializers may be listed as inputs too; they stay constants.
    fn add_inputs(&mut self, graph: &'a GraphProto) -> Result<Vec<Input>, ModelError> {
        let mut inputs = Vec::new();
        for input in &graph.input {
            match self.values.get(input.name.as_str()) {
                Some(Value::Constant(_)) => continue,
                Some(_) => return Err(another_input(&input.name)),
                None => {}
            }
            check_count("inputs", inputs.len() + 1, MAX_INPUTS)?;
            let width = input_width(input)?;
            let column = |index| Column { input: inputs.len(), index, ops: Vec::new() };
            let columns = (0..width).map(column).collect();
            self.values.insert(&input.name, Value::Columns(columns));
            inputs.push(Input { name: input.name.clone(), width });
        }
        Ok(inputs)
    }

    /// Accounts for `n_bytes` of memory.
    fn charge(&mut self, n_bytes: usize) -> Result<(), ModelError> {
        let too_large = || ModelError::TooLarge {
            what: "bytes of numbers",
            got: self.max_bytes.saturating_add(n_bytes),
            most: self.max_bytes,
        };
        self.bytes_left = self.bytes_left.checked_sub(n_bytes).ok_or_else(too_large)?;
        Ok(())
    }

    fn charge_columns(&mut self, columns: &[Column]) -> Result<(), ModelError> {
        check_count("numbers before the first layer", columns.len(), MAX_COLUMNS)?;
        let column_bytes = |column: &Column| {
            size_of::<Column>() + 4 * size_of::<Op>() + 2 * size_of_val(&*column.ops)
        };
        self.charge(columns.iter().map(column_bytes).sum())
    }

    /// Appends one operation for each number of `value`, which is not a constant.
    fn each(&mut self, value: Value<'a>, ops: Vec<Op>) -> Result<Value<'a>, ModelError> {
        match value {
            Value::Columns(mut columns) => {
                self.charge_columns(&columns)?;
                for (column, op) in columns.iter_mut().zip(ops) {
                    column.ops.push(op);
                }
                Ok(Value::Columns(columns))
            }
            Value::Hidden { step, width } => {
                self.charge(width * size_of::<Op>())?;
                self.links.push(Link { before: Before::Step(step), step: Step::Each(ops) });
                Ok(Value::Hidden { step: self.links.len() - 1, width })
            }
            constant @ Value::Constant(_) => Ok(constant),
        }
    }

    /// Appends a layer to `value`, which is not a constant.
    fn layer(&mut self, value: Value<'a>, layer: Layer) -> Value<'a> {
        let before = match value {
            Value::Columns(columns) => Before::Columns(columns),
            Value::Hidden { step, .. } => Before::Step(step),
            Value::Constant(_) => Before::Columns(Vec::new()),
        };
        let width = layer.bias.len();
        self.links.push(Link { before, step: Step::Layer(layer) });
        Value::Hidden { step: self.links.len() - 1, width }
    }

    /// Returns the network that computes the value `output`.
    fn into_network(mut self, inputs: Vec<Input>, output: &str) -> Result<Network, ModelError> {
        let refused = |problem: &str| ModelError::Value {
            kind: "output",
            name: output.to_owned(),
            problem: problem.to_owned(),
        };
        let Some(Value::Hidden { step, width }) = self.values.remove(output) else {
            return Err(refused("no layer (Gemm or MatMul) computes it"));
        };
        // A step follows those that it depends on.
        let mut next = step;
        self.links.truncate(step + 1);
        let mut steps = Vec::new();
        let mut columns = Vec::new();
        while let Some(link) = self.links.pop() {
            if self.links.len() != next {
                continue;
            }
            steps.push(link.step);
            match link.before {
                Before::Step(before) => next = before,
                Before::Columns(first) => {
                    columns = first;
                    break;
                }
            }
        }
        steps.reverse();
        Ok(Network { inputs, output: output.to_owned(), n_output: width, columns, steps })
    }
}

impl NodeProto {
    /// Returns the error for this node.
    fn refused(&self, problem: impl Into<String>) -> ModelError {
        let first = self.output.first().map_or("", String::as_str);
        let node = if self.name.is_empty() { first } else { &self.name };
        ModelError::Node {
            node: tandem_core::text::shortened(node, 80),
            operator: tandem_core::text::shortened(&self.op_type, 40),
            problem: problem.into(),
        }
    }
}
