//! Graphs that are read, and graphs that are refused.

use prost::Message as _;

use super::Model;
use crate::network::{Op, Step};
use crate::onnx_proto::{
    AttributeProto, BOOL, DimensionProto, FLOAT, GraphProto, ModelProto, NodeProto,
    OperatorSetIdProto, TensorProto, TensorShapeProto, TensorTypeProto, TypeProto, ValueInfoProto,
};

fn tensor(name: &str, dims: &[i64], numbers: &[f32]) -> TensorProto {
    TensorProto {
        dims: dims.to_vec(),
        data_type: FLOAT,
        float_data: numbers.to_vec(),
        name: name.to_owned(),
        ..TensorProto::default()
    }
}

fn value(name: &str, width: i64) -> ValueInfoProto {
    let dim = [None, Some(width)].map(|dim_value| DimensionProto { dim_value, dim_param: None });
    let shape = Some(TensorShapeProto { dim: dim.to_vec() });
    let tensor_type = Some(TensorTypeProto { elem_type: FLOAT, shape });
    ValueInfoProto { name: name.to_owned(), r#type: Some(TypeProto { tensor_type }) }
}

/// Parses `OPERATOR inputs... -> output`, with integer attributes as `name=1`.
fn node(text: &str) -> NodeProto {
    let (left, output) = text.split_once(" -> ").unwrap();
    let mut words = left.split(' ');
    let op_type = words.next().unwrap().to_owned();
    let (attributes, inputs): (Vec<&str>, Vec<&str>) = words.partition(|word| word.contains('='));
    let attribute = |text: &&str| {
        let (name, i) = text.split_once('=').unwrap();
        AttributeProto { name: name.to_owned(), i: i.parse().unwrap(), ..AttributeProto::default() }
    };
    NodeProto {
        input: inputs.iter().map(|name| name.trim_matches('_').to_owned()).collect(),
        output: vec![output.to_owned()],
        op_type,
        attribute: attributes.iter().map(attribute).collect(),
        ..NodeProto::default()
    }
}

/// A model with inputs `a` and `b` of two numbers and the constants below.
fn model(nodes: &[&str]) -> ModelProto {
    let initializer = vec![
        tensor("w", &[2, 3], &[1.0, 2.0, 3.0, 4.0, 5.0, 6.0]),
        tensor("w4", &[4, 1], &[1.0, 10.0, 100.0, 1000.0]),
        tensor("wt", &[3, 2], &[1.0, 4.0, 2.0, 5.0, 3.0, 6.0]),
        tensor("c3", &[3], &[0.5, -0.5, 0.25]),
        tensor("c2", &[1, 2], &[2.0, 4.0]),
        tensor("column", &[2, 1], &[2.0, 4.0]),
        tensor("zeros", &[2], &[0.0, 1.0]),
        tensor("one", &[], &[1.0]),
        tensor("minus", &[1], &[-1.0]),
        tensor("nan", &[2], &[f32::NAN, 1.0]),
        TensorProto { data_type: 11, ..tensor("double", &[2], &[]) },
        TensorProto { data_type: BOOL, raw_data: vec![0], ..tensor("false", &[], &[]) },
        TensorProto { data_type: BOOL, raw_data: vec![1], ..tensor("true", &[], &[]) },
        TensorProto { data_location: 1, ..tensor("elsewhere", &[2, 3], &[]) },
        tensor("short", &[2, 3], &[1.0]),
    ];
    let graph = GraphProto {
        node: nodes.iter().map(|text| node(text)).collect(),
        initializer,
        input: vec![value("a", 2), value("b", 2)],
        output: vec![value("y", 3)],
        ..GraphProto::default()
    };
    let opset = OperatorSetIdProto { domain: String::new(), version: 13 };
    ModelProto { graph: Some(graph), opset_import: vec![opset], ..ModelProto::default() }
}

fn outputs(nodes: &[&str], a: [f32; 2], b: [f32; 2]) -> Vec<f32> {
    let network = Model::decode(&model(nodes).encode_to_vec()).unwrap().network;
    let inputs = [a, b];
    let columns = network.columns.iter();
    let mut row = columns.map(|column| column.apply(inputs[column.input][column.index])).collect();
    network.run(&mut row, &mut Vec::new());
    row
}

#[test]
fn operators_compute_what_onnx_defines() {
    let check = |nodes: &[&str], expected: &[f32]| {
        assert_eq!(outputs(nodes, [1.0, -2.0], [0.5, 3.0]), expected, "{nodes:?}");
    };
    check(&["MatMul a w -> y"], &[-7.0, -8.0, -9.0]);
    check(&["Gemm a w c3 -> y"], &[-6.5, -8.5, -8.75]);
    check(&["Gemm a wt c3 transB=1 -> y"], &[-6.5, -8.5, -8.75]);
    check(&["Transpose wt -> t", "MatMul a t -> y"], &[-7.0, -8.0, -9.0]);
    check(&["MatMul b w -> h", "Add c3 h -> y"], &[13.0, 15.5, 19.75]);
    check(&["MatMul a w -> h", "Relu h -> y"], &[0.0; 3]);
    check(&["Gemm a w _ -> h", "Clip h minus one -> y"], &[-1.0; 3]);
    check(&["Sub a c2 -> x", "Div x c2 -> z", "MatMul z w -> y"], &[-6.5, -8.5, -10.5]);
    check(&["Sub c2 a -> x", "MatMul x w -> y"], &[25.0, 32.0, 39.0]);
    check(&["Transpose column -> t", "Sub t a -> x", "MatMul x w -> y"], &[25.0, 32.0, 39.0]);
    check(&["Max a one -> x", "Min x one -> z", "MatMul z w -> y"], &[5.0, 7.0, 9.0]);
    check(&["Concat b a axis=1 -> x", "MatMul x w4 -> y"], &[0.5 + 30.0 + 100.0 - 2000.0]);
    check(&["Clip a _ minus -> x", "Flatten x -> z", "MatMul z w -> y"], &[-9.0, -12.0, -15.0]);
    let tanh = outputs(&["MatMul a w -> h", "Tanh h -> y"], [0.1, 0.0], [0.0; 2]);
    assert!((tanh[2] - 0.3_f32.tanh()).abs() < 1e-7, "{tanh:?}");
}

#[test]
fn nodes_that_the_output_does_not_need_are_ignored() {
    let nodes = ["LSTM a -> rest", "MatMul a w -> y", "Softmax y -> unused"];
    assert_eq!(outputs(&nodes, [1.0, -2.0], [0.0; 2]), [-7.0, -8.0, -9.0]);
}

#[test]
fn a_value_that_is_used_twice_keeps_its_steps_apart() {
    let nodes = ["MatMul a w -> h", "Relu h -> side", "Add h c3 -> y"];
    let network = Model::decode(&model(&nodes).encode_to_vec()).unwrap().network;
    assert_eq!(network.steps.len(), 2);
    assert_eq!(network.steps[1], Step::Each(vec![Op::Add(0.5), Op::Add(-0.5), Op::Add(0.25)]));
}

#[test]
fn a_refusal_names_the_node_its_operator_and_what_is_supported() {
    let check = |nodes: &[&str], expected: &str| {
        let refusal = Model::decode(&model(nodes).encode_to_vec()).expect_err("must be refused");
        let refusal = refusal.to_string();
        assert!(refusal.contains(expected), "{refusal:?} lacks {expected:?}");
    };
    check(
        &["Gelu a -> x", "MatMul x w -> y"],
        "node \"x\" (Gelu): the operator is not supported, supported are Gemm, MatMul, Add,",
    );
    check(&["MatMul a w4 -> y"], "(MatMul): its rows have 2 numbers, its weight takes 4");
    check(&["MatMul a b -> y"], "(MatMul): input 2 must be a constant");
    check(&["Gemm a w c3 transA=1 -> y"], "transA is not supported");
    check(
        &["Dropout a one true -> x", "MatMul x w -> y"],
        "(Dropout): only inference (training_mode false) is supported",
    );
    check(&["MatMul a w -> h", "Add h h -> y"], "(Add): one of its inputs must be a constant");
    check(&["Div a zeros -> x", "MatMul x w -> y"], "(Div): it divides by 0");
    check(&["Div c2 a -> x", "MatMul x w -> y"], "a constant divided by rows");
    check(&["Clip a one minus -> x", "MatMul x w -> y"], "its bounds are 1 and -1");
    check(&["MatMul a w -> h", "Concat h a axis=1 -> y"], "only inputs can be concatenated");
    check(&["Concat a b axis=0 -> y"], "only axis 1 is supported");
    check(&["MatMul missing w -> y"], "computes its input \"missing\"");
    check(&["Add a nan -> x", "MatMul x w -> y"], "\"nan\": it holds a number that is not finite");
    check(&["Add a c3 -> x", "MatMul x w -> y"], "its shape is [3], expected one number or [2]");
    for column in ["Transpose c2 -> c", "Identity column -> c"] {
        check(&[column, "Add a c -> x", "MatMul x w -> y"], "its shape is [2, 1], expected");
    }
    check(
        &["Flatten zeros -> c", "Add a c -> x", "MatMul x w -> y"],
        "(Flatten): only axis 1 of a matrix is supported",
    );
    check(&["Add a double -> x", "MatMul x w -> y"], "its type is number 11, expected 1 (float32)");
    check(&["MatMul a elsewhere -> y"], "external_data=False");
    check(&["MatMul a short -> y"], "it has 1 numbers, its shape is [2, 3]");
    check(&["Relu a -> y"], "output \"y\": no layer (Gemm or MatMul) computes it");
    check(&["MatMul a w -> y", "MatMul b w -> y"], "an earlier node computes \"y\" too");
    check(&["MatMul b w -> a", "MatMul a w -> y"], "an input or initializer is named \"a\" too");
    check(&["Identity y -> y"], "computes its input \"y\"");
}

#[test]
fn models_of_other_kinds_are_refused() {
    let check = |edit: fn(&mut ModelProto), expected: &str| {
        let mut model = model(&["MatMul a w -> y"]);
        edit(&mut model);
        let refusal = Model::decode(&model.encode_to_vec()).expect_err("must be refused");
        assert_eq!(refusal.to_string(), expected);
    };
    check(|model| model.graph = None, "it has no graph");
    check(
        |model| model.opset_import[0].version = 99,
        "it uses version 99 of the operators (opset), expected 7 to 25",
    );
    let outputs =
        "it has 2 outputs, expected one, or one named action, actions, value, values, q, output";
    check(|model| model.graph.as_mut().unwrap().output.push(value("z", 1)), outputs);
    check(
        |model| model.graph.as_mut().unwrap().input[0] = value("a", 12_289),
        "input \"a\": expected shape [batch, n] with n from 1 to 12288",
    );
    check(
        |model| model.graph.as_mut().unwrap().input[1].r#type = None,
        "input \"b\": it is not a tensor",
    );
    check(
        |model| model.graph.as_mut().unwrap().input[1] = value("a", 2),
        "input \"a\": another input has the same name",
    );
    check(
        |model| model.graph.as_mut().unwrap().initializer.push(tensor("w", &[1], &[1.0])),
        "tensor \"w\": another initializer has the same name",
    );
}

#[test]
fn a_graph_that_multiplies_its_constants_is_refused() {
    let wide = tensor("wide", &[600, 600], &vec![0.0; 360_000]);
    let mut model = model(&[]);
    let graph = model.graph.as_mut().unwrap();
    graph.initializer.push(wide);
    graph.input[0] = value("a", 600);
    let matmul = |idx: usize| {
        let input = if idx == 0 { "a".to_owned() } else { format!("h{}", idx - 1) };
        node(&format!("MatMul {input} wide -> h{idx}"))
    };
    graph.node = (0..100).map(matmul).collect();
    graph.output = vec![value("h99", 600)];
    let refusal = Model::decode(&model.encode_to_vec()).expect_err("must be refused").to_string();
    assert!(refusal.contains("bytes of numbers, expected at most"), "{refusal}");
}
