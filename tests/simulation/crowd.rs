//! A teacher alone on a simulated network, asked by many at once who have no leases and share one account.

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

use crate::books::{Ledgers, SharedBook, Watched};
use crate::machines::{House, Machines, with_causes};
use crate::network::{address, client_config, listen};
use crate::schedule::{Host, Schedule};

const TEACHER: Host = "teacher";
/// Hosts of those who ask.
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
/// Less than they ask for.
pub(crate) const BUDGET: u64 = 500;
const ACCOUNT: &str = "crowd";
/// Simulated time within which most of what goes wrong begins.
const SPAN: Duration = Duration::from_secs(1);
/// For an answer; who waits longer asks again.
const ANSWER: Duration = Duration::from_secs(2);
const PAUSE: Duration = Duration::from_millis(50);

/// Lets the crowd ask while much goes wrong; gives how many times a step was asked about again, or what went wrong
/// that must not.
pub(crate) fn simulate_crowd(seed: u64, ledgers: &Ledgers) -> Result<u64, String> {
    let links: Vec<(Host, Host)> = CLIENTS.iter().map(|client| (*client, TEACHER)).collect();
    let schedule = Schedule::draw(seed, &links, &[TEACHER], &CLIENTS, SPAN);
    let stage = Rc::new(Stage::default());
    let mut machines = Machines::new(&schedule, &stage.house, links, |_| {});
    let for_teacher = Rc::clone(&stage);
    machines.add(TEACHER, move || {
        let ledger = Watched::new(ledgers.open(), for_teacher.book.clone());
        Rc::clone(&for_teacher).teacher(ledger)
    });
    for (client_idx, client) in CLIENTS.iter().enumerate() {
        let for_client = Rc::clone(&stage);
        machines.add(client, move || Rc::clone(&for_client).client(client_idx));
    }
    let ended = machines.run_until(|| stage.have_all_asked().then_some(()));
    machines.end();
    let told = |what| format!("{what}\n{schedule}");
    ended.and_then(|()| stage.check(ledgers)).map_err(told)
}

/// What outlives the processes on the hosts.
struct Stage {
    house: Rc<House>,
    book: SharedBook,
    /// What clients were told of steps, by episode and step.
    charged: RefCell<BTreeMap<(u64, u32), bool>>,
    have_asked: RefCell<BTreeSet<usize>>,
}

impl Default for Stage {
    fn default() -> Self {
        Self {
            house: Rc::default(),
            book: Arc::new(Mutex::default()),
            charged: RefCell::default(),
            have_asked: RefCell::default(),
        }
    }
}

impl Stage {
    async fn teacher(self: Rc<Self>, ledger: Watched) -> turmoil::Result {
        let advisor = Advisor::new(Box::new(Still), Box::new(ledger))?;
        let (server_config, for_ever) = (ServerConfig::default(), CancellationToken::new());
        let served =
            serve_advisor(advisor, listen().await?, &server_config, for_ever, Pacing::Lockstep)
                .await;
        if let Err(error) = served {
            self.house.complain(with_causes(TEACHER, &error));
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
            let request = pb::AdviseRequest { account: ACCOUNT.to_owned(), steps: steps.collect() };
            let answer = ask(&client, |mut client| {
                let request = request.clone();
                async move { client.advise(request).await }
            })
            .await;
            for (step, advice) in (first..).zip(answer.steps) {
                self.hear(episode, step, advice.charged);
            }
        }
        self.have_asked.borrow_mut().insert(client_idx);
        Ok(())
    }

    fn hear(&self, episode: u64, step: u32, charged: bool) {
        let before = self.charged.borrow_mut().insert((episode, step), charged);
        if before.is_some_and(|before| before != charged) {
            self.house.complain(format!(
                "one heard of step {step} of episode {episode} charged: {charged}, another the opposite"
            ));
        }
    }

    fn have_all_asked(&self) -> bool {
        self.have_asked.borrow().len() == CLIENTS.len()
    }

    /// Each unit is one step's, and none is left over.
    fn check(&self, ledgers: &Ledgers) -> Result<u64, String> {
        let book = self.book.lock().expect("nobody panics");
        let complaint = self.house.complaint().or_else(|| book.complaints.first().cloned());
        if let Some(complaint) = complaint {
            return Err(complaint);
        }
        let balance = ledgers.open().balance(ACCOUNT).map_err(|error| error.to_string())?;
        let charged = self.charged.borrow();
        let n_heard = charged.values().filter(|charged| **charged).count() as u64;
        let counts = [n_heard, book.n_charged(ACCOUNT), balance.spent];
        let n_steps = u64::from(N_STEPS) * N_EPISODES;
        if charged.len() as u64 != n_steps || counts != [BUDGET; 3] || balance.left != 0 {
            let n_answered = charged.len();
            return Err(format!(
                "of {n_answered} steps answered {counts:?} are charged: heard, written down, spent; {balance:?}"
            ));
        }
        Ok(book.n_repeats)
    }
}

/// Asks until there is an answer.
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
    })
}

/// A teacher that keeps its arm still.
struct Still;

impl TeacherPolicy for Still {
    fn layout(&self) -> Layout {
        STILL
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
