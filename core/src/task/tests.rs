use super::*;
use crate::episode::Episode;

/// A task of two arms with interleaved numbers: an arm's position and speed are two apart, goals and actions in
/// reverse order of the arms.
fn interleaved() -> TaskDescription {
    let arm = |first: usize| ArmDescription {
        observation: vec![first, first + 2],
        goal: vec![1 - first],
        action: vec![1 - first],
        position: vec![first],
        lateral: Vec::new(),
        hand: Vec::new(),
    };
    TaskDescription {
        name: "lab/reach-1".to_owned(),
        n_observation: 4,
        n_goal: 2,
        n_action: 2,
        arms: vec![arm(0), arm(1)],
        achieved_goal: vec![1, 0],
        episode_steps: 20,
        tolerance: 0.1,
        norm: Norm::Maximum,
        interchangeable_arms: true,
        reports_contacts: false,
        origin_distance: 1.0,
        recombination_gap: 0.2,
        base: 0.0,
        contact_distances: Vec::new(),
        observation_bound: vec![2.0; 4],
        goal_bound: vec![1.0; 2],
        manipulation: Manipulation::default(),
        reflection: Reflection::default(),
    }
}

/// An arm of the interleaved task that holds while its position is within 0.1 of 0.5; its speed must be at most 0.2.
fn holding(arm: usize) -> ArmManipulation {
    let condition =
        |numbers, target, tolerance| Condition { numbers: vec![numbers], target, tolerance };
    ArmManipulation {
        gripper: Some(1 - arm),
        holding: vec![condition(arm, vec![0.5], 0.1)],
        conditions: vec![condition(arm + 2, Vec::new(), 0.2)],
    }
}

/// A task in which two arms carry one object, whose position and goal belong to neither.
fn carried() -> TaskDescription {
    let arm = |idx: usize| ArmDescription {
        observation: vec![idx],
        action: vec![idx],
        ..ArmDescription::default()
    };
    TaskDescription {
        n_observation: 3,
        n_goal: 1,
        arms: vec![arm(0), arm(1)],
        achieved_goal: vec![2],
        observation_bound: vec![2.0; 3],
        goal_bound: vec![1.0],
        ..interleaved()
    }
}

#[test]
fn a_built_in_task_has_the_parts_of_its_layout() {
    for (task, n_arms) in [(Task::Push, 1), (Task::PickAndPlace, 2), (Task::Push, 8)] {
        let layout = Layout::new(task, n_arms);
        let spec = TaskSpec::new(layout.description()).unwrap();
        assert_eq!(spec, layout.into());
        assert_eq!(spec.as_built_in(), Some(layout));
        assert_eq!(spec.name(), task.name());
        assert_eq!(spec.single_arm(), Some(Layout::new(task, 1).into()));
        assert_eq!(spec.single_arm().unwrap().concatenated(n_arms), Ok(spec.clone()));
        for arm in layout.arms() {
            assert_eq!(spec.observation_of(arm).as_range(), Some(layout.observation_of(arm)));
            assert_eq!(spec.goal_of(arm).as_range(), Some(layout.goal_of(arm)));
            assert_eq!(spec.action_of(arm).as_range(), Some(layout.action_of(arm)));
            assert_eq!(spec.achieved_goal_of(arm).as_range(), Some(layout.achieved_goal_of(arm)));
        }
    }
}

#[test]
fn interleaved_parts_are_found_by_their_indices() {
    let task = TaskSpec::new(interleaved()).unwrap();
    assert_eq!(task.as_built_in(), None);
    let observation = [0.5, -0.5, 10.0, 20.0];
    assert_eq!(*task.observation_of(ArmIndex(1)).of(&observation), [-0.5, 20.0]);
    assert_eq!(*task.achieved_goal_of(ArmIndex(0)).of(&observation), [0.5]);
    assert_eq!(task.achieved_goal(&observation).collect::<Vec<f32>>(), [-0.5, 0.5]);
    assert_eq!(task.observation_in_arm_order(&observation), [0.5, 10.0, -0.5, 20.0]);
    let mut action = [0.0; 2];
    task.write_action_in_arm_order(&[0.25, -0.25], &mut action);
    assert_eq!((action, task.action_in_arm_order(&action)), ([-0.25, 0.25], vec![0.25, -0.25]));
    let goal = [-0.45, 0.8];
    assert!(!task.arm_succeeds(ArmIndex(0), &observation, &goal), "0.5 is not 0.8");
    assert!(task.arm_succeeds(ArmIndex(1), &observation, &goal));
    assert!(!task.is_success(&observation, &goal));
    assert!(task.is_success(&[0.75, -0.5, 0.0, 0.0], &goal));
    assert_eq!(task.goal_distances(&[0.5, -0.5, 0.0, 0.0], &[0.25, 0.75]), [0.25, 0.75]);
}

#[test]
fn each_arm_is_an_instance_of_the_one_arm_task() {
    let one = TaskSpec::new(interleaved()).unwrap().single_arm().unwrap();
    assert_eq!((one.n_observation(), one.n_goal(), one.n_action(), one.n_arms()), (2, 1, 1, 1));
    assert_eq!((one.episode_steps(), one.tolerance(), one.norm()), (20, 0.1, Norm::Maximum));
    assert_eq!(one.achieved_goal(&[3.0, 4.0]).collect::<Vec<f32>>(), [3.0]);
    assert_eq!(one.single_arm().as_ref(), Some(&one));
    let three = one.concatenated(3).unwrap();
    assert_eq!(three.observation_of(ArmIndex(2)).as_range(), Some(4..6));
    assert_eq!(three.achieved_goal_of(ArmIndex(1)).as_range(), Some(2..3));
    assert_eq!(three.single_arm(), Some(one.clone()));
    assert_eq!(one.concatenated(9).unwrap_err().field, "number of arms");
}

#[test]
fn arms_whose_parts_differ_have_no_one_arm_task() {
    let single_arm = |change: fn(&mut TaskDescription)| {
        let mut description = interleaved();
        description.arms.iter_mut().for_each(|arm| arm.position.clear());
        description.manipulation.arms = vec![holding(0), holding(1)];
        change(&mut description);
        TaskSpec::new(description).unwrap().single_arm()
    };
    assert!(single_arm(|_| ()).is_some());
    let check = |difference: &str, change: fn(&mut TaskDescription)| {
        assert_eq!(single_arm(change), None, "{difference}");
    };
    check("the order of an observation", |t| t.arms[1].observation = vec![3, 1]);
    check("the number that achieves the goal", |t| t.achieved_goal[0] = 3);
    check("a number of the other arm achieves the goal", |t| t.achieved_goal[0] = 0);
    check("a bound", |t| t.observation_bound[3] = 1.0);
    check("the gripper", |t| t.manipulation.arms[1].gripper = None);
    check("a condition", |t| t.manipulation.arms[1].conditions[0].tolerance = 0.3);
}

#[test]
fn a_reflection_acts_on_the_part_of_one_arm_and_is_its_own_inverse() {
    let mut description = interleaved();
    description.reflection = Reflection {
        observation: vec![0],
        position: vec![1],
        goal: vec![0],
        action: vec![],
        moved: vec![[0, 1], [1, 0]],
        plane: 0.25,
        whole_scene: false,
    };
    let task = TaskSpec::new(description).unwrap();
    let (first, second) = (ArmIndex(0), ArmIndex(1));
    let mut observation = [0.0; 4];
    task.reflect_observation(first, second, &[1.0, 2.0, 3.0, 4.0], &mut observation);
    assert_eq!(observation, [-4.0, 0.0, -1.5, 0.0], "2 and 4 are the second arm's");
    let (mut goal, mut action) = ([9.0; 2], [9.0; 2]);
    task.reflect_goal(second, second, &[0.5, 0.6], &mut goal);
    task.reflect_action(first, second, &[0.7, 0.8], &mut action);
    assert_eq!((goal, action), ([0.0, 9.0], [9.0, 0.7]), "goals and actions in reverse order");

    let shared = TaskSpec::built_in(Task::SharedPickAndPlace, 1);
    let original: Vec<f32> = (1..29).map(|number| number as f32).collect();
    let reflect = |observation: &[f32]| {
        let mut reflected = vec![0.0; 28];
        shared.reflect_observation(first, first, observation, &mut reflected);
        reflected
    };
    let once = reflect(&original);
    assert_eq!(once[..3], [1.0, -2.0, 3.0]);
    assert_eq!(once[9..12], [12.0, 12.0, 10.0], "two places show the first finger");
    assert_eq!(once[12..16], [-13.0, 14.0, -15.0, 16.0], "the rotation about y keeps its sense");
    let twice = reflect(&once);
    let same = |idx: &usize| ![10, 26].contains(idx);
    assert!((0..28).filter(same).all(|idx| twice[idx] == original[idx]), "{twice:?}");
    assert!(!TaskSpec::built_in(Task::PickAndPlace, 1).has_reflection());
}

#[test]
fn a_reflection_names_places_of_an_arm_once() {
    let check = |change: fn(&mut Reflection), message: &str| {
        let mut description = interleaved();
        change(&mut description.reflection);
        assert_eq!(TaskSpec::new(description).unwrap_err().to_string(), message);
    };
    check(|it| it.goal = vec![1], "reflection.goal[0]: expected 0 to 0, got 1");
    check(|it| it.moved = vec![[0, 2]], "reflection.moved[0]: expected 0 to 1, got 2");
    check(|it| (it.observation, it.position) = (vec![1], vec![0, 1]), {
        "reflection.observation: expected each place once, got 1"
    });
    check(|it| it.plane = f32::NAN, "reflection.plane: expected a finite number, got NaN");
    check(|it| it.action = vec![0, 0], "reflection.action: expected each place once, got 0");
    let expected = "reflection: expected none, or observations and goals in which every number belongs to an arm, got \
                    numbers that belong to no arm";
    let reflection = Reflection { action: vec![0], ..Reflection::default() };
    let carried = TaskDescription { reflection, ..carried() };
    assert_eq!(TaskSpec::new(carried).unwrap_err().to_string(), expected);
}

#[test]
fn success_needs_the_goal_and_every_condition_for_as_many_steps_as_described() {
    let mut description = interleaved();
    description.arms.iter_mut().for_each(|arm| arm.position.clear());
    description.manipulation = Manipulation {
        shared_object: true,
        success_steps: 2,
        arms: vec![holding(0), holding(1)],
        ..Manipulation::default()
    };
    let task = TaskSpec::new(description).unwrap();
    let goal = [0.5, 0.5];
    let check = |observation: [f32; 4], holds: [bool; 2], succeed: [bool; 2]| {
        assert_eq!([0, 1].map(|arm| task.arm_holds(ArmIndex(arm), &observation)), holds);
        let succeeded = [0, 1].map(|arm| task.arm_succeeds(ArmIndex(arm), &observation, &goal));
        assert_eq!(succeeded, succeed, "{observation:?}");
        assert_eq!(task.is_success(&observation, &goal), succeed == [true; 2]);
        assert!(task.arm_reaches_goal(ArmIndex(0), &[0.5, 0.0, 9.0, 9.0], &goal));
    };
    check([0.5, 0.45, 0.1, -0.1], [true, true], [true, true]);
    check([0.5, 0.45, 0.3, -0.1], [true, true], [false, true]);
    check([0.5, 0.35, 0.1, 0.1], [true, false], [true, false]);

    let mut episode = Episode::zeros(&task, 0);
    episode.goal.fill(0.5);
    let last_steps = |episode: &mut Episode, n: usize| {
        let start = (task.episode_steps() + 1 - n) * task.n_observation();
        for observation in episode.observations[start..].chunks_exact_mut(4) {
            observation.copy_from_slice(&[0.5, 0.5, 0.0, 0.0]);
        }
        (episode.succeeded(), episode.arm_succeeded(ArmIndex(1)))
    };
    assert_eq!(last_steps(&mut episode, 1), (false, false), "one step of two");
    assert_eq!(last_steps(&mut episode, 2), (true, true));
    let one = task.single_arm().unwrap();
    assert_eq!((one.success_steps(), one.gripper_of(ArmIndex(0))), (2, Some(0)));
    assert!(one.arm_holds(ArmIndex(0), &[0.45, 9.0]) && !one.shares_object());
    assert!(one.concatenated(2).unwrap().arm_holds(ArmIndex(1), &[0.0, 0.0, 0.45, 0.0]));
}

#[test]
fn each_arm_that_carries_a_bar_performs_pick_and_place() {
    let built_in = TaskSpec::built_in(Task::CarryBar, 2);
    assert_eq!((built_in.n_observation(), built_in.n_goal(), built_in.n_action()), (56, 6, 8));
    assert!(built_in.has_interchangeable_arms() && !built_in.has_recombinable_arms());
    // The same task under another name is data alone.
    let description =
        TaskDescription { name: "lab/carry".to_owned(), ..built_in.description().clone() };
    let pick_and_place = TaskSpec::built_in(Task::PickAndPlace, 1);
    for task in [built_in, TaskSpec::new(description).unwrap()] {
        assert_eq!(task.single_arm().as_ref(), Some(&pick_and_place));
    }
}

#[test]
fn a_common_goal_counts_for_every_arm_and_has_no_one_arm_task() {
    let task = TaskSpec::new(TaskDescription { name: "carry".to_owned(), ..carried() }).unwrap();
    assert_eq!(task.common_observation().as_range(), Some(2..3));
    for arm in task.arms() {
        assert!(task.arm_succeeds(arm, &[9.0, 9.0, 0.35], &[0.4]));
        assert!(!task.arm_succeeds(arm, &[0.4, 0.4, 0.2], &[0.4]));
    }
    assert_eq!(task.goal_distances(&[9.0, 9.0, 0.25], &[0.5]), [0.0, 0.0, 0.25]);
    assert_eq!(task.single_arm(), None);
    assert!(!task.has_recombinable_arms());
}

/// The task of one arm whose vectors are `interleaved` with nothing.
fn of_one_arm() -> TaskDescription {
    TaskSpec::new(interleaved()).unwrap().single_arm().unwrap().description().clone()
}

#[test]
fn a_task_of_one_arm_is_its_own_only_in_the_order_of_the_arm_and_without_common_numbers() {
    let mut common = of_one_arm();
    (common.n_observation, common.observation_bound) = (3, vec![2.0; 3]);
    assert_eq!(TaskSpec::new(common).unwrap().single_arm(), None);
    let mut reversed = of_one_arm();
    (reversed.arms[0].observation, reversed.achieved_goal) = (vec![1, 0], vec![1]);
    let single = TaskSpec::new(reversed.clone()).unwrap().single_arm().unwrap();
    assert_eq!(*single.description(), of_one_arm(), "not the order in which its policies learned");
    assert!(single.difference(&TaskSpec::new(reversed).unwrap()).is_some());
}

#[test]
fn arms_with_hands_and_distances_of_contacts_can_be_concatenated() {
    let mut one = of_one_arm();
    one.arms[0].hand = vec![0, 1, 0];
    one.contact_distances = vec![0.1; 3];
    let two = TaskSpec::new(one).unwrap().concatenated(2).unwrap();
    assert_eq!((two.n_arms(), two.describes_contacts()), (2, false));
}

#[test]
fn distances_of_contacts_need_hands() {
    let with = |hand: bool, distances: &[f32]| {
        let mut description = interleaved();
        for (arm_idx, arm) in description.arms.iter_mut().enumerate().filter(|_| hand) {
            arm.hand = vec![arm_idx, arm_idx + 2, arm_idx];
        }
        description.contact_distances = distances.to_vec();
        TaskSpec::new(description).map(|task| task.describes_contacts())
    };
    assert_eq!((with(true, &[0.1; 3]), with(true, &[])), (Ok(true), Ok(false)));
    for (hand, distances) in [
        (false, &[0.1; 3][..]),
        (true, &[0.1; 2]),
        (true, &[0.1, 0.0, 0.1]),
        (true, &[f32::NAN; 3]),
    ] {
        let refused = with(hand, distances).unwrap_err();
        assert_eq!(refused.field, "contact_distances", "{distances:?}");
    }
}

#[test]
fn an_invalid_description_is_refused_by_field() {
    let check = |change: fn(&mut TaskDescription), message: &str| {
        let mut description = interleaved();
        change(&mut description);
        assert_eq!(TaskSpec::new(description).unwrap_err().to_string(), message);
    };
    let names = "1 to 64 lower-case letters, digits, '-', '_', '.' and '/'";
    check(|t| t.name.clear(), &format!("name: expected {names}, got \"\""));
    check(|t| t.name = "Reach".to_owned(), &format!("name: expected {names}, got \"Reach\""));
    check(|t| t.n_observation = 4097, "n_observation: expected 1 to 4096, got 4097");
    check(|t| t.n_goal = 0, "n_goal: expected 1 to 4096, got 0");
    check(|t| t.episode_steps = 10_001, "episode_steps: expected 1 to 10000, got 10001");
    check(|t| t.tolerance = f32::NAN, "tolerance: expected a finite number above 0, got NaN");
    check(|t| t.achieved_goal = vec![0], "achieved_goal: expected 2 numbers, got 1");
    check(|t| t.achieved_goal[1] = 4, "achieved_goal[1]: expected 0 to 3, got 4");
    check(|t| t.observation_bound[3] = 0.0, {
        "observation_bound[3]: expected a finite number above 0, got 0"
    });
    check(|t| t.goal_bound.push(1.0), "goal_bound: expected 2 numbers, got 3");
    check(|t| t.arms.clear(), "number of arms: expected 1 to 8, got 0");
    check(|t| t.arms[1].goal[0] = 7, "arms[1].goal[0]: expected 0 to 1, got 7");
    check(|t| t.arms[1].observation.truncate(1), {
        "arms[1].observation: expected 2 numbers, got 1"
    });
    check(|t| t.arms[1].observation[0] = 2, {
        "arms[1].observation[0]: expected an index that no arm has yet, got 2"
    });
    check(|t| t.n_action = 3, {
        "arms: expected every index of an action in the action of an arm, got none with index 2"
    });
    check(|t| t.recombination_gap = -1.0, {
        "recombination_gap: expected a finite number, 0 or more, got -1"
    });
    check(|t| t.arms[0].position[0] = 1, {
        "arms[0].position: expected no index, or observations and goals in which every number, the \
         achieved goal and these positions belong to the arm, got 1 indices"
    });
    check(|t| t.manipulation.success_steps = 21, {
        "manipulation.success_steps: expected 1 to 20, got 21"
    });
    check(|t| t.manipulation.shared_object = true, {
        "manipulation.shared_object: expected false for arms with positions, which are recombined, \
         got true"
    });
    check(|t| t.manipulation.arms = vec![holding(0)], {
        "manipulation.arms: expected none or 2, got 1"
    });
    check(|t| t.manipulation.arms = vec![holding(1), holding(0)], {
        "manipulation.arms[0].gripper: expected an action of the arm, got 0"
    });
    check(
        |t| t.manipulation.arms = vec![holding(0), ArmManipulation { gripper: None, ..holding(0) }],
        {
            "manipulation.arms[1]: expected numbers of the arm's observation in every condition, got 0"
        },
    );
    check(|t| t.name = "push".to_owned(), {
        "name: expected a name other than that of the built-in task push, got push, whose \
         n_observation is 56 and 4"
    });
}
