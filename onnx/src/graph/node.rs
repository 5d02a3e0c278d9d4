//! The supported operators.

use tandem_policy::policy::MAX_HIDDEN;

use super::constant::Constant;
use super::{Interpreter, Value};
use crate::error::ModelError;
use crate::network::{Layer, Op};
use crate::onnx_proto::{AttributeProto, FLOAT, NodeProto};

/// The supported operators, for messages.
pub(super) const SUPPORTED: &str = "Gemm, MatMul, Add, Sub, Mul, Div, Min, Max, Clip, Relu, Tanh, Concat, Identity, \
    Dropout, Flatten, Cast, Constant and Transpose";

type Interpreted<'a> = Result<Value<'a>, ModelError>;

/// Returns the first output of `node`.
pub(super) fn interpret<'a>(
    interpreter: &mut Interpreter<'a>,
    node: &'a NodeProto,
) -> Interpreted<'a> {
    if !(node.domain.is_empty() || node.domain == "ai.onnx") {
        let domain = &node.domain;
        return Err(
            node.refused(format!("domain {domain:?} is not supported, only the standard one"))
        );
    }
    match node.op_type.as_str() {
        "Constant" => constant(node),
        "Concat" => concat(interpreter, node),
        "Gemm" => gemm(interpreter, node),
        "MatMul" => mat_mul(interpreter, node),
        "Transpose" => transpose(interpreter, node),
        "Add" | "Sub" | "Mul" | "Div" | "Min" | "Max" => binary(interpreter, node),
        "Clip" => clip(interpreter, node),
        "Relu" => activation(interpreter, node, Op::Relu),
        "Tanh" => activation(interpreter, node, Op::Tanh),
        "Identity" => value_of(interpreter, node, 0),
        "Dropout" => {
            // Version 12 added the mode as input 3; the earlier ones never drop.
            let trains = match constant_of(interpreter, node, 2)? {
                Some(mode) => mode.flag()?,
                None => false,
            };
            unchanged_if(interpreter, node, !trains, "inference (training_mode false)")
        }
        "Flatten" => {
            // It makes matrices of constants of other ranks.
            let is_matrix = match value_of(interpreter, node, 0)? {
                Value::Constant(constant) => constant.rank() == 2,
                Value::Columns(_) | Value::Hidden { .. } => true,
            };
            let is_unchanged = is_matrix && int(node, "axis", 1) == 1;
            unchanged_if(interpreter, node, is_unchanged, "axis 1 of a matrix")
        }
        "Cast" => {
            let is_float = int(node, "to", 0) == i64::from(FLOAT);
            unchanged_if(interpreter, node, is_float, "a cast to float32")
        }
        _ => Err(node.refused(format!("the operator is not supported, supported are {SUPPORTED}"))),
    }
}

fn attribute<'a>(node: &'a NodeProto, name: &str) -> Option<&'a AttributeProto> {
    node.attribute.iter().find(|attribute| attribute.name == name)
}

fn int(node: &NodeProto, name: &str, default: i64) -> i64 {
    attribute(node, name).map_or(default, |attribute| attribute.i)
}

fn float(node: &NodeProto, name: &str, default: f32) -> f32 {
    attribute(node, name).map_or(default, |attribute| attribute.f)
}

/// Returns the name of an input; `None` if it is left out.
fn input_name(node: &NodeProto, idx: usize) -> Option<&str> {
    node.input.get(idx).map(String::as_str).filter(|name| !name.is_empty())
}

fn value_of<'a>(
    interpreter: &mut Interpreter<'a>,
    node: &'a NodeProto,
    idx: usize,
) -> Interpreted<'a> {
    let name = input_name(node, idx)
        .ok_or_else(|| node.refused(format!("input {} is missing", idx + 1)))?;
    let value = interpreter.values.get(name).cloned().ok_or_else(|| {
        node.refused(format!("no earlier node, input or initializer computes its input {name:?}"))
    })?;
    if let Value::Columns(columns) = &value {
        interpreter.charge_columns(columns)?;
    }
    Ok(value)
}

/// Returns an input that must not be a constant.
fn rows_of<'a>(
    interpreter: &mut Interpreter<'a>,
    node: &'a NodeProto,
    idx: usize,
) -> Interpreted<'a> {
    match value_of(interpreter, node, idx)? {
        Value::Constant(_) => Err(node.refused("it combines constants: fold them when exporting")),
        rows => Ok(rows),
    }
}

/// Returns an input that must be a constant; `None` if it is left out.
fn constant_of<'a>(
    interpreter: &mut Interpreter<'a>,
    node: &'a NodeProto,
    idx: usize,
) -> Result<Option<Constant<'a>>, ModelError> {
    if input_name(node, idx).is_none() {
        return Ok(None);
    }
    match value_of(interpreter, node, idx)? {
        Value::Constant(constant) => Ok(Some(constant)),
        _ => Err(node.refused(format!("input {} must be a constant", idx + 1))),
    }
}

const fn width(value: &Value<'_>) -> usize {
    match value {
        Value::Constant(_) => 0,
        Value::Columns(columns) => columns.len(),
        Value::Hidden { width, .. } => *width,
    }
}

fn constant(node: &NodeProto) -> Interpreted<'_> {
    let tensor = attribute(node, "value").and_then(|attribute| attribute.t.as_ref());
    let tensor = tensor.ok_or_else(|| node.refused("expected a tensor as attribute \"value\""))?;
    Ok(Value::Constant(Constant::new(tensor)))
}

fn unchanged_if<'a>(
    interpreter: &mut Interpreter<'a>,
    node: &'a NodeProto,
    is_supported: bool,
    supported: &str,
) -> Interpreted<'a> {
    if is_supported {
        value_of(interpreter, node, 0)
    } else {
        Err(node.refused(format!("only {supported} is supported")))
    }
}

fn transpose<'a>(interpreter: &mut Interpreter<'a>, node: &'a NodeProto) -> Interpreted<'a> {
    let Some(constant) = constant_of(interpreter, node, 0)? else {
        return Err(node.refused("input 1 is missing"));
    };
    let order = attribute(node, "perm").map_or(&[1, 0][..], |attribute| &attribute.ints);
    if constant.rank() == 2 && order == [1, 0] {
        return Ok(Value::Constant(constant.transposed()));
    }
    Err(node.refused("only a constant matrix can be transposed"))
}

fn concat<'a>(interpreter: &mut Interpreter<'a>, node: &'a NodeProto) -> Interpreted<'a> {
    if ![1, -1].contains(&int(node, "axis", 0)) {
        return Err(node.refused("only axis 1 is supported"));
    }
    let mut joined = Vec::new();
    for idx in 0..node.input.len() {
        match value_of(interpreter, node, idx)? {
            Value::Columns(columns) => joined.extend(columns),
            _ => {
                return Err(node.refused("only inputs can be concatenated, before the first layer"));
            }
        }
        interpreter.charge_columns(&joined)?;
    }
    Ok(Value::Columns(joined))
}

fn activation<'a>(
    interpreter: &mut Interpreter<'a>,
    node: &'a NodeProto,
    op: Op,
) -> Interpreted<'a> {
    let rows = rows_of(interpreter, node, 0)?;
    let ops = vec![op; width(&rows)];
    interpreter.each(rows, ops)
}

fn clip<'a>(interpreter: &mut Interpreter<'a>, node: &'a NodeProto) -> Interpreted<'a> {
    let rows = rows_of(interpreter, node, 0)?;
    let mut bounds = [float(node, "min", f32::NEG_INFINITY), float(node, "max", f32::INFINITY)];
    if interpreter.opset >= 11 {
        bounds = [f32::NEG_INFINITY, f32::INFINITY];
        for (idx, bound) in bounds.iter_mut().enumerate() {
            if let Some(constant) = constant_of(interpreter, node, idx + 1)? {
                *bound = constant.scalar()?;
            }
        }
    }
    let [low, high] = bounds;
    if low.is_nan() || high.is_nan() || low > high {
        return Err(node.refused(format!("its bounds are {low} and {high}")));
    }
    let ops = vec![Op::Clip(low, high); width(&rows)];
    interpreter.each(rows, ops)
}

/// Interprets an elementwise operation with a constant.
fn binary<'a>(interpreter: &mut Interpreter<'a>, node: &'a NodeProto) -> Interpreted<'a> {
    if node.input.len() != 2 {
        return Err(node.refused("expected two inputs"));
    }
    let values = (value_of(interpreter, node, 0)?, value_of(interpreter, node, 1)?);
    let (rows, constant, is_constant_first) = match values {
        (Value::Constant(_), Value::Constant(_)) => {
            return Err(node.refused("it combines constants: fold them when exporting"));
        }
        (rows, Value::Constant(constant)) => (rows, constant, false),
        (Value::Constant(constant), rows) => (rows, constant, true),
        _ => return Err(node.refused("one of its inputs must be a constant")),
    };
    let n = width(&rows);
    interpreter.charge(n * size_of::<f32>())?;
    let numbers = constant.row(n)?;
    let op: fn(f32) -> Op = match (node.op_type.as_str(), is_constant_first) {
        ("Add", _) => Op::Add,
        ("Mul", _) => Op::Mul,
        ("Min", _) => |c| Op::Clip(f32::NEG_INFINITY, c),
        ("Max", _) => |c| Op::Clip(c, f32::INFINITY),
        ("Sub", false) => Op::Sub,
        ("Sub", true) => Op::Add,
        ("Div", false) if numbers.contains(&0.0) => return Err(node.refused("it divides by 0")),
        ("Div", false) => Op::Div,
        _ => return Err(node.refused("a constant divided by rows is not supported")),
    };
    let rows = match is_constant_first && node.op_type == "Sub" {
        true => interpreter.each(rows, vec![Op::Mul(-1.0); n])?,
        false => rows,
    };
    interpreter.each(rows, numbers.into_iter().map(op).collect())
}

fn mat_mul<'a>(interpreter: &mut Interpreter<'a>, node: &'a NodeProto) -> Interpreted<'a> {
    let rows = rows_of(interpreter, node, 0)?;
    let weight = constant_of(interpreter, node, 1)?;
    let weight = ScaledInput { constant: weight, factor: 1.0 };
    layer(interpreter, node, rows, weight, ScaledInput { constant: None, factor: 1.0 })
}

fn gemm<'a>(interpreter: &mut Interpreter<'a>, node: &'a NodeProto) -> Interpreted<'a> {
    if int(node, "transA", 0) != 0 {
        return Err(node.refused("transA is not supported"));
    }
    let rows = rows_of(interpreter, node, 0)?;
    let weight = constant_of(interpreter, node, 1)?;
    let weight = match int(node, "transB", 0) {
        0 => weight,
        _ => weight.map(Constant::transposed),
    };
    let bias = constant_of(interpreter, node, 2)?;
    let weight = ScaledInput { constant: weight, factor: float(node, "alpha", 1.0) };
    let bias = ScaledInput { constant: bias, factor: float(node, "beta", 1.0) };
    layer(interpreter, node, rows, weight, bias)
}

/// A constant input of a node, if it is there, and the factor by which the node multiplies it.
#[derive(Debug, Clone, Copy)]
struct ScaledInput<'a> {
    constant: Option<Constant<'a>>,
    factor: f32,
}

fn layer<'a>(
    interpreter: &mut Interpreter<'a>,
    node: &'a NodeProto,
    rows: Value<'a>,
    weight: ScaledInput<'a>,
    bias: ScaledInput<'a>,
) -> Interpreted<'a> {
    let matrix = weight.constant.ok_or_else(|| node.refused("input 2 is missing"))?;
    let [n_in, n_out] = matrix.matrix_shape()?;
    if n_in != width(&rows) {
        let got = width(&rows);
        return Err(node.refused(format!("its rows have {got} numbers, its weight takes {n_in}")));
    }
    if n_out > MAX_HIDDEN {
        return Err(node.refused(format!("it has {n_out} units, expected at most {MAX_HIDDEN}")));
    }
    interpreter.charge((n_in + 1) * n_out * size_of::<f32>())?;
    let scaled = |mut numbers: Vec<f32>, factor: f32| {
        numbers.iter_mut().for_each(|number| *number *= factor);
        let is_finite = numbers.iter().all(|number| number.is_finite());
        is_finite.then_some(numbers).ok_or_else(|| node.refused("alpha or beta is too large"))
    };
    let weight = scaled(matrix.matrix()?, weight.factor)?;
    let bias = match bias.constant {
        Some(row) => scaled(row.row(n_out)?, bias.factor)?,
        None => vec![0.0; n_out],
    };
    Ok(interpreter.layer(rows, Layer { weight, bias }))
}
