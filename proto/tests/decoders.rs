//! For arbitrary input, a decoder either accepts a message unchanged or refuses it with the name of a field.

use proptest::collection::{size_range, vec};
use proptest::prelude::{
    BoxedStrategy, Just, ProptestConfig, Strategy, TestCaseError, any, prop_assert, prop_assert_eq,
    prop_oneof, proptest,
};
use proptest::sample::select;
use prost::Message;
use tandem_core::layout::EPISODE_STEPS;
use tandem_core::task::MAX_ARMS;
use tandem_core::{Layout, Task};
use tandem_proto::{DecodeError, pb};

/// Largest length of an error message, which is sent in a header.
const MAX_ERROR_BYTES: usize = 400;

fn settings(cases: u32) -> ProptestConfig {
    ProptestConfig { cases, failure_persistence: None, ..ProptestConfig::default() }
}

fn any_layout() -> impl Strategy<Value = Layout> {
    (select(Task::ALL.to_vec()), 1..=MAX_ARMS).prop_map(|(task, n_arms)| Layout::new(task, n_arms))
}

/// One of `n` numbers. Nearly all are ordinary, so most vectors are valid.
fn any_number(n: usize) -> BoxedStrategy<f32> {
    let edges = [
        f32::NAN,
        f32::INFINITY,
        f32::NEG_INFINITY,
        f32::MAX,
        f32::MIN_POSITIVE / 2.0,
        -0.0,
        0.0,
        1.0,
        -1.0,
        1.0 + 2e-6,
    ];
    let plain = u32::try_from(8 * n.max(1)).expect("some thousand numbers");
    prop_oneof![plain => -1.0_f32..1.0, 1 => select(edges.to_vec()), 1 => any::<f32>()].boxed()
}

/// A single number; edge cases are as likely as ordinary numbers.
fn one_number() -> BoxedStrategy<f32> {
    prop_oneof![4 => 0.0_f32..1.5, 1 => any::<f32>(), 1 => select(vec![f32::NAN, -0.0, f32::INFINITY])].boxed()
}

/// Mostly `n` numbers, otherwise one more, one less, none or half of them.
fn numbers(n: usize) -> BoxedStrategy<Vec<f32>> {
    length_near(n).prop_flat_map(|n| vec(any_number(n), size_range(n))).boxed()
}

fn length_near(n: usize) -> BoxedStrategy<usize> {
    prop_oneof![20 => Just(n), 1 => Just(n + 1), 1 => Just(n.saturating_sub(1)), 1 => Just(0), 1 => Just(n / 2)].boxed()
}

/// The same as bytes, sometimes with an incomplete number at the end.
fn number_bytes(n: usize) -> BoxedStrategy<Vec<u8>> {
    let rest = prop_oneof![20 => Just(0_usize), 1 => 1_usize..4];
    (numbers(n), rest)
        .prop_map(|(numbers, n_rest)| {
            let whole = numbers.iter().flat_map(|number| number.to_le_bytes());
            whole.chain(std::iter::repeat_n(0, n_rest)).collect()
        })
        .boxed()
}

fn any_text() -> BoxedStrategy<String> {
    let oversize = (200_usize..300).prop_map(|n| "x".repeat(n));
    let huge = Just("é".repeat(100_000));
    prop_oneof![1 => Just(String::new()), 4 => "[a-z-]{1,20}", 1 => any::<String>(), 1 => oversize, 1 => huge].boxed()
}

fn any_task_name() -> BoxedStrategy<String> {
    prop_oneof![8 => select(vec!["push".to_owned(), "pick-and-place".to_owned()]), 1 => any_text()]
        .boxed()
}

fn any_count(most: u32) -> BoxedStrategy<u32> {
    prop_oneof![8 => 0..=most, 1 => Just(most + 1), 1 => any::<u32>()].boxed()
}

fn query(layout: Layout) -> impl Strategy<Value = pb::StepQuery> {
    (
        any::<u64>(),
        any::<u32>(),
        numbers(layout.n_observation()),
        numbers(layout.n_goal()),
        numbers(layout.n_action()),
        prop_oneof![1 => Just(Vec::new()), 1 => numbers(layout.n_action())],
        any::<Option<u64>>(),
    )
        .prop_map(
            |(episode, step, observation, goal, proposed_action, judged_action, payer)| {
                pb::StepQuery {
                    episode,
                    step,
                    observation,
                    goal,
                    proposed_action,
                    judged_action,
                    payer,
                }
            },
        )
}

fn arm_advice(layout: Layout) -> impl Strategy<Value = pb::ArmAdvice> {
    (
        numbers(layout.single_arm().n_action()),
        any_number(8),
        any_number(8),
        any_number(8),
        one_number(),
        any::<bool>(),
    )
        .prop_map(
            |(teacher_action, q_teacher, q_student, importance, distance, overridden)| {
                pb::ArmAdvice {
                    teacher_action,
                    q_teacher,
                    q_student,
                    importance,
                    distance,
                    overridden,
                }
            },
        )
}

fn advice(layout: Layout) -> impl Strategy<Value = pb::StepAdvice> {
    let arms = length_near(layout.n_arms)
        .prop_flat_map(move |n_arms| vec(arm_advice(layout), size_range(n_arms)));
    (numbers(layout.n_action()), any::<bool>(), arms, any::<bool>()).prop_map(
        |(action, charged, arms, repeated)| pb::StepAdvice { action, charged, arms, repeated },
    )
}

fn terms() -> impl Strategy<Value = pb::RunTerms> {
    let exploration =
        (one_number(), one_number(), prop_oneof![1.0_f32..50.0, one_number()], any::<bool>())
            .prop_map(|(noise_std, random_share, random_hold_mean_steps, joint)| pb::Exploration {
                noise_std,
                random_share,
                random_hold_mean_steps,
                joint_random_actions: joint,
            });
    let advice = (any::<bool>(), any::<bool>()).prop_map(|(policy, slots)| pb::AdviceTerms {
        judges_policy_action: policy,
        charges_slot_steps: slots,
    });
    let removed = prop_oneof![4 => Just(0.0), 1 => one_number()];
    let world = (one_number(), removed, any_count(10_000), any::<u64>()).prop_map(
        |(gripped_start_share, wide_start_share, substeps, steps)| pb::WorldTerms {
            gripped_start_share,
            wide_start_share,
            substeps,
            gripped_start_env_steps: steps,
            randomization: 0.0,
        },
    );
    let part = 0.9;
    (
        any_task_name(),
        any_count(8),
        any_text(),
        proptest::option::weighted(part, exploration),
        proptest::option::weighted(part, world),
        any_text(),
        (advice.prop_map(Some), any::<bool>()),
    )
        .prop_map(|(task, n_arms, account, exploration, world, run, (advice, symmetrized))| {
            pb::RunTerms {
                description: None,
                advice,
                symmetrized_evaluation: symmetrized,
                task,
                n_arms,
                account,
                exploration,
                world,
                run,
            }
        })
}

fn slot() -> impl Strategy<Value = pb::Slot> {
    let flags = (any::<bool>(), any::<bool>(), any::<bool>(), any::<bool>());
    let order = (any::<u64>(), any::<u64>(), flags, any::<Option<u32>>()).prop_map(
        |(number, seed, (advised, uniform, record, greedy), advised_steps)| pb::EpisodeOrder {
            number,
            seed,
            advised,
            uniform,
            record,
            advised_steps,
            greedy,
        },
    );
    let n_episodes = prop_oneof![10 => 0_usize..20, 1 => Just(1024_usize), 1 => Just(1025_usize)];
    let episodes = n_episodes.prop_flat_map(move |n| vec(order.clone(), size_range(n)));
    (any::<u64>(), any::<u64>(), any_kind(), episodes).prop_map(
        |(slot, parameter_version, kind, episodes)| pb::Slot {
            slot,
            parameter_version,
            kind,
            episodes,
        },
    )
}

fn any_kind() -> impl Strategy<Value = i32> {
    prop_oneof![12 => 1_i32..=2, 1 => Just(0), 1 => Just(3), 1 => any::<i32>()]
}

fn parameters(layout: Layout) -> impl Strategy<Value = pb::Parameters> {
    let sizes = (1_u32..6, 1_u32..4);
    let claimed = (any_count(16_384), any_count(64));
    let deviations = |n| prop_oneof![4 => Just(std::iter::repeat_n(0.5_f32.to_le_bytes(), n).flatten().collect()), 1 => number_bytes(n)];
    sizes.prop_flat_map(move |(n_hidden, n_layers)| {
        let hidden = prop_oneof![8 => Just((n_hidden, n_layers)), 1 => claimed.clone()];
        (
            hidden,
            number_bytes(n_parameters(layout, n_hidden as usize, n_layers as usize)),
            number_bytes(layout.n_observation()),
            deviations(layout.n_observation()),
            number_bytes(layout.n_goal()),
            deviations(layout.n_goal()),
        )
            .prop_map(
                |(hidden, actor, observation_mean, observation_std, goal_mean, goal_std)| {
                    pb::Parameters {
                        version: 7,
                        n_hidden: hidden.0,
                        n_layers: hidden.1,
                        actor,
                        observation_mean,
                        observation_std,
                        goal_mean,
                        goal_std,
                        ..pb::Parameters::default()
                    }
                },
            )
    })
}

/// The number of parameters, layer by layer.
fn n_parameters(layout: Layout, n_hidden: usize, n_layers: usize) -> usize {
    let mut widths = vec![layout.n_observation() + layout.n_goal()];
    widths.extend(std::iter::repeat_n(n_hidden, n_layers));
    widths.push(layout.n_action());
    widths.windows(2).map(|pair| (pair[0] + 1) * pair[1]).sum()
}

fn episode(layout: Layout) -> impl Strategy<Value = pb::Episode> {
    let arms = (1_u16 << layout.n_arms) - 1;
    let bits = move |most: u16| {
        let step = prop_oneof![500 => 0..=most, 1 => 0_u16..256];
        length_near(EPISODE_STEPS).prop_flat_map(move |n| {
            let steps = vec(step.clone(), size_range(n));
            steps.prop_map(|steps| {
                steps
                    .into_iter()
                    .map(|bits| u8::try_from(bits).expect("a byte"))
                    .collect::<Vec<u8>>()
            })
        })
    };
    (
        (
            any::<u64>(),
            any_kind(),
            any::<u64>(),
            any_count(50),
            proptest::option::of(any_count(50)),
        ),
        number_bytes((EPISODE_STEPS + 1) * layout.n_observation()),
        number_bytes(layout.n_goal()),
        number_bytes(EPISODE_STEPS * layout.n_action()),
        bits(arms),
        bits(3),
    )
        .prop_map(|(head, observations, goal, actions, advised_arms, contacts)| pb::Episode {
            number: head.0,
            kind: head.1,
            parameter_version: head.2,
            observations,
            goal,
            actions,
            advised_arms,
            contacts,
            advice_charged: head.3,
            avoidance_steps: head.4,
            queried_steps: head.4,
        })
}

/// Checks a decoder's result, encoded again: it is either the original message or an error about one of its fields.
fn check<M: Message + std::fmt::Debug>(
    original: &M,
    result: Result<M, DecodeError>,
) -> Result<(), TestCaseError> {
    match result {
        Ok(again) => prop_assert_eq!(again.encode_to_vec(), original.encode_to_vec()),
        Err(error) => {
            let head = error.field.split(['.', '[']).next().unwrap_or_default();
            let debug = format!("{original:?}");
            prop_assert!(!head.is_empty() && debug.contains(&format!("{head}: ")), "{error}");
            prop_assert!(!error.expected.is_empty() && !error.got.is_empty(), "{error}");
            prop_assert!(
                error.to_string().len() < MAX_ERROR_BYTES,
                "{} bytes",
                error.to_string().len()
            );
        }
    }
    Ok(())
}

fn check_query(original: &pb::StepQuery, layout: Layout) -> Result<(), TestCaseError> {
    let result = tandem_proto::decode_query(original.clone(), layout);
    check(original, result.map(|query| tandem_proto::encode_query(&query)))
}

fn check_advice(original: &pb::StepAdvice, layout: Layout) -> Result<(), TestCaseError> {
    let result = tandem_proto::decode_advice(original.clone(), layout);
    check(original, result.map(|advice| tandem_proto::encode_advice(&advice)))
}

fn check_terms(original: &pb::RunTerms) -> Result<(), TestCaseError> {
    let result = tandem_proto::decode_run_terms(original.clone());
    check(original, result.map(|terms| tandem_proto::encode_run_terms(&terms)))
}

fn check_slot(original: &pb::Slot) -> Result<(), TestCaseError> {
    let result = tandem_proto::decode_slot(original.clone());
    check(original, result.map(|slot| tandem_proto::encode_slot(&slot)))
}

fn check_parameters(original: &pb::Parameters, layout: Layout) -> Result<(), TestCaseError> {
    let result = tandem_proto::decode_actor(original, layout);
    check(original, result.map(|actor| tandem_proto::encode_actor(&actor)))
}

fn check_episode(original: &pb::Episode, layout: Layout) -> Result<(), TestCaseError> {
    let result = tandem_proto::decode_episode(original.clone(), layout);
    check(original, result.map(|episode| tandem_proto::encode_episode(&episode)))
}

/// Decodes `bytes` as every message type, and passes the messages to their decoders.
fn read_as_everything(bytes: &[u8], layout: Layout) -> Result<(), TestCaseError> {
    macro_rules! read_as {
        ($($message:ident),*) => {$(
            if let Ok(message) = pb::$message::decode(bytes) {
                let again = pb::$message::decode(message.encode_to_vec().as_slice());
                prop_assert_eq!(again.map(|again| again.encode_to_vec()), Ok(message.encode_to_vec()));
            }
        )*};
    }
    read_as!(
        JoinRequest,
        JoinResponse,
        NextWorkRequest,
        NextWorkResponse,
        GetParametersRequest,
        SubmitEpisodesRequest,
        SubmitEpisodesResponse,
        StatusRequest,
        WatchRequest,
        Progress,
        DescribeRequest,
        DescribeResponse,
        OpenAccountRequest,
        GetAccountRequest,
        Account,
        AdviseRequest,
        AdviseResponse,
        OpenLeasesRequest,
        OpenLeasesResponse,
        SettleLeasesRequest
    );
    macro_rules! check_as {
        ($($message:ident: $check:expr;)*) => {$(
            if let Ok(message) = pb::$message::decode(bytes) {
                $check(&message)?;
            }
        )*};
    }
    check_as! {
        StepQuery: |query| check_query(query, layout);
        StepAdvice: |advice| check_advice(advice, layout);
        RunTerms: check_terms;
        Slot: check_slot;
        Parameters: |parameters| check_parameters(parameters, layout);
        Episode: |episode| check_episode(episode, layout);
    }
    Ok(())
}

/// The bytes of a message, some of them changed, truncated or extended.
fn mutated<M: Message + 'static>(
    message: impl Strategy<Value = M>,
) -> impl Strategy<Value = Vec<u8>> {
    let edits = vec((any::<usize>(), any::<u8>()), 0..4);
    let cut = prop_oneof![2 => Just(None), 1 => any::<usize>().prop_map(Some)];
    (message, edits, cut, vec(any::<u8>(), 0..3)).prop_map(|(message, edits, cut, more)| {
        let mut bytes = message.encode_to_vec();
        bytes.extend(more);
        for (at, byte) in edits {
            // Most bytes of a message are numbers; the first ones determine the meaning of the rest.
            let at = if at % 2 == 0 { at / 2 % 16 } else { at / 2 };
            if let Some(place) = bytes.len().checked_sub(1).map(|last| at % (last + 1)) {
                bytes[place] = byte;
            }
        }
        if let Some(cut) = cut {
            let n_kept = cut % (bytes.len() + 1);
            bytes.truncate(n_kept);
        }
        bytes
    })
}

proptest! {
    #![proptest_config(settings(800))]

    #[test]
    fn a_query_is_accepted_or_refused(
        (layout, query) in any_layout().prop_flat_map(|layout| (Just(layout), query(layout))),
    ) {
        check_query(&query, layout)?;
    }

    #[test]
    fn advice_is_accepted_or_refused(
        (layout, advice) in any_layout().prop_flat_map(|layout| (Just(layout), advice(layout))),
    ) {
        check_advice(&advice, layout)?;
    }

    #[test]
    fn run_terms_are_accepted_or_refused(terms in terms()) {
        check_terms(&terms)?;
    }

    #[test]
    fn names_of_accounts_are_accepted_by_length(name in any_text()) {
        let result = tandem_proto::decode_account_name("account", name.clone());
        prop_assert_eq!(result.is_ok(), (1..=256).contains(&name.len()));
        if let Ok(kept) = result {
            prop_assert_eq!(kept, name);
        }
    }
}

proptest! {
    #![proptest_config(settings(300))]

    #[test]
    fn a_slot_is_accepted_or_refused(slot in slot()) {
        check_slot(&slot)?;
    }

    #[test]
    fn parameters_are_accepted_or_refused(
        (layout, parameters) in any_layout().prop_flat_map(|layout| (Just(layout), parameters(layout))),
    ) {
        check_parameters(&parameters, layout)?;
    }

    #[test]
    fn an_episode_is_accepted_or_refused(
        (layout, episode) in any_layout().prop_flat_map(|layout| (Just(layout), episode(layout))),
    ) {
        check_episode(&episode, layout)?;
    }

    #[test]
    fn altered_messages_are_accepted_or_refused(
        layout in any_layout(),
        query in mutated(query(Layout::new(Task::Push, 2))),
        advice in mutated(advice(Layout::new(Task::Push, 2))),
        terms in mutated(terms()),
        slot in mutated(slot()),
    ) {
        for bytes in [query, advice, terms, slot] {
            read_as_everything(&bytes, layout)?;
        }
    }
}

proptest! {
    #![proptest_config(settings(1500))]

    #[test]
    fn arbitrary_bytes_are_accepted_or_refused(bytes in vec(any::<u8>(), 0..80), layout in any_layout()) {
        read_as_everything(&bytes, layout)?;
    }
}
