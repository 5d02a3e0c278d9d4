//! A teacher on a simulated network with many concurrent clients that share one account and have no leases.

use std::cell::RefCell;
use std::collections::{BTreeMap, BTreeSet};
use std::rc::Rc;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use tandem_core::{Layout, StepQuery, Task};
use tandem_net::{AuthChannel, Pacing, ServerConfig};
use tandem_proto::pb::teacher_client::TeacherClient;
use tandem_proto::{encode_query, pb};
use tandem_teacher::{Advisor, TeacherPolicy, serve_advisor};
use tokio_util::sync::CancellationToken;
use tonic::{Response, Status};

use crate::ledgers::{Ledgers, ObservedLedger, SharedRecord};
use crate::machines::{Machines, ProcessTracker, with_causes};
use crate::network::{address, client_config, listen};
use crate::schedule::{Host, Schedule};

const TEACHER: Host = "teacher";
/// Hosts of the clients.
const CLIENTS: [Host; 16] = [
    "client-1",
    "client-2",
    "client-3",
    "client-4",
    "client-5",
    "client-6",
    "client-7",
    "client-8",
    "client-9",
    "client-10",
    "client-11",
    "client-12",
    "client-13",
    "client-14",
    "client-15",
    "client-16",
];
/// Several clients ask about the same episodes.
const N_EPISODES: u64 = 12;
/// Steps of each, in requests of [`STEPS_PER_REQUEST`].
const N_STEPS: u32 = 60;
const STEPS_PER_REQUEST: u32 = 6;
/// Less than the clients request.
pub(crate) const BUDGET: u64 = 500;
const ACCOUNT: &str = "crowd";
/// Simulated time within which most faults start.
const SPAN: Duration = Duration::from_secs(1);
/// Timeout of a request, after which the client retries.
const ANSWER: Duration = Duration::from_secs(2);
const PAUSE: Duration = Duration::from_millis(50);

/// Simulates the crowd under faults. Returns the number of repeated requests for a step, or the first violation.
pub(crate) fn simulate_crowd(seed: u64, ledgers: &Ledgers) -> Result<u64, String> {
    let links: Vec<(Host, Host)> = CLIENTS.iter().map(|client| (*client, TEACHER)).collect();
    let schedule = Schedule::draw(seed, &links, &[TEACHER], &CLIENTS, SPAN);
    let state = Rc::new(CrowdState::default());
    let mut machines = Machines::new(&schedule, &state.tracker, links, |_| {});
    let for_teacher = Rc::clone(&state);
    machines.add(TEACHER, move || {
        let ledger = ObservedLedger::new(ledgers.open(), for_teacher.record.clone());
        Rc::clone(&for_teacher).teacher(ledger)
    });
    for (client_idx, client) in CLIENTS.iter().enumerate() {
        let for_client = Rc::clone(&state);
        machines.add(client, move || Rc::clone(&for_client).client(client_idx));
    }
    let ended = machines.run_until(|| state.have_all_finished().then_some(()));
    machines.end();
    let describe = |what| format!("{what}\n{schedule}");
    ended.and_then(|()| state.check(ledgers)).map_err(describe)
}

/// State that outlives the processes.
struct CrowdState {
    tracker: Rc<ProcessTracker>,
    record: SharedRecord,
    /// The clients' answers by episode and step: true if charged.
    charged: RefCell<BTreeMap<(u64, u32), bool>>,
    finished: RefCell<BTreeSet<usize>>,
}

impl Default for CrowdState {
    fn default() -> Self {
        Self {
            tracker: Rc::default(),
            record: Arc::new(Mutex::default()),
            charged: RefCell::default(),
            finished: RefCell::default(),
        }
    }
}

impl CrowdState {
    async fn teacher(self: Rc<Self>, ledger: ObservedLedger) -> turmoil::Result {
        let advisor = Advisor::new(Box::new(StillTeacher), Box::new(ledger))?;
        let (server_config, shutdown) = (ServerConfig::default(), CancellationToken::new());
        let served =
            serve_advisor(advisor, listen().await?, &server_config, shutdown, Pacing::Lockstep)
                .await;
        if let Err(error) = served {
            self.tracker.report_violation(with_causes(TEACHER, &error));
        }
        Ok(())
    }

    async fn client(self: Rc<Self>, client_idx: usize) -> turmoil::Result {
        let client = TeacherClient::new(client_config().channel(&address(TEACHER))?);
        let account = pb::OpenAccountRequest {
            name: ACCOUNT.to_owned(),
            budget: BUDGET,
            strategy: "ea".to_owned(),
        };
        ask(&client, |mut client| {
            let account = account.clone();
            async move { client.open_account(account).await }
        })
        .await;
        let episode = client_idx as u64 % N_EPISODES;
        for first in (0..N_STEPS).step_by(STEPS_PER_REQUEST as usize) {
            let steps = (first..first + STEPS_PER_REQUEST).map(|step| query(episode, step));
            let request = pb::AdviseRequest {
                account: ACCOUNT.to_owned(),
                steps: steps.collect(),
                ..Default::default()
            };
            let answer = ask(&client, |mut client| {
                let request = request.clone();
                async move { client.advise(request).await }
            })
            .await;
            for (step, advice) in (first..).zip(answer.steps) {
                self.record_answer(episode, step, advice.charged);
            }
        }
        self.finished.borrow_mut().insert(client_idx);
        Ok(())
    }

    fn record_answer(&self, episode: u64, step: u32, charged: bool) {
        let before = self.charged.borrow_mut().insert((episode, step), charged);
        if before.is_some_and(|before| before != charged) {
            self.tracker.report_violation(format!(
                "the answers about step {step} of episode {episode} differ: charged {charged} and the opposite"
            ));
        }
    }

    fn have_all_finished(&self) -> bool {
        self.finished.borrow().len() == CLIENTS.len()
    }

    /// Checks that each unit pays for exactly one step and that none is left.
    fn check(&self, ledgers: &Ledgers) -> Result<u64, String> {
        let record = self.record.lock().expect("not poisoned");
        let violation =
            self.tracker.first_violation().or_else(|| record.violations.first().cloned());
        if let Some(violation) = violation {
            return Err(violation);
        }
        let balance = ledgers.open().balance(ACCOUNT).map_err(|error| error.to_string())?;
        let charged = self.charged.borrow();
        let n_reported = charged.values().filter(|charged| **charged).count() as u64;
        let counts = [n_reported, record.n_charged(ACCOUNT), balance.spent];
        let n_steps = u64::from(N_STEPS) * N_EPISODES;
        if charged.len() as u64 != n_steps || counts != [BUDGET; 3] || balance.left != 0 {
            let n_answered = charged.len();
            return Err(format!(
                "of {n_answered} answered steps, {counts:?} were charged (clients, record, account); {balance:?}"
            ));
        }
        Ok(record.n_repeats)
    }
}

/// Repeats a call until it succeeds.
async fn ask<T, F>(
    client: &TeacherClient<AuthChannel>,
    call: impl Fn(TeacherClient<AuthChannel>) -> F,
) -> T
where
    F: Future<Output = Result<Response<T>, Status>>,
{
    loop {
        match tokio::time::timeout(ANSWER, call(client.clone())).await {
            Ok(Ok(answer)) => return answer.into_inner(),
            Ok(Err(_)) | Err(_) => tokio::time::sleep(PAUSE).await,
        }
    }
}

const STUDENT: Layout = Layout::new(Task::Push, 2);
const STILL: Layout = Layout::new(Task::Push, 1);

fn query(episode: u64, step: u32) -> pb::StepQuery {
    encode_query(&StepQuery {
        episode,
        step,
        observation: vec![0.0; STUDENT.n_observation()],
        goal: vec![0.0; STUDENT.n_goal()],
        proposed_action: vec![1.0; STUDENT.n_action()],
        judged_action: None,
        payer: None,
    })
}

/// A teacher that keeps its arm still.
struct StillTeacher;

impl TeacherPolicy for StillTeacher {
    fn task(&self) -> tandem_core::TaskSpec {
        STILL.into()
    }

    fn digest(&self) -> &str {
        "still"
    }

    fn act(&mut self, _observations: &[f32], _goals: &[f32], actions: &mut [f32]) {
        actions.fill(0.0);
    }

    fn q(&mut self, _observations: &[f32], _goals: &[f32], _actions: &[f32], q: &mut [f32]) {
        q.fill(0.0);
    }
}
