//! A teacher that keeps accounts as a real one does, and can be away, strict or forgetful.

use std::collections::{BTreeMap, BTreeSet};
use std::net::SocketAddr;
use std::sync::{Arc, Mutex, MutexGuard};

use tandem_core::TaskSpec;
use tandem_net::ServerConfig;
use tandem_proto::pb::teacher_server::{Teacher, TeacherServer};
use tandem_proto::{encode_task, pb};
use tokio::net::TcpListener;
use tokio_util::sync::CancellationToken;
use tonic::{Request, Response, Status, Streaming};

use crate::service_tests::toy::LAYOUT;

#[derive(Default, Clone)]
pub(crate) struct FakeTeacher {
    books: Arc<Mutex<Books>>,
}

#[derive(Default)]
pub(crate) struct Books {
    pub(crate) accounts: BTreeMap<String, Account>,
    /// The error that every call returns, if set.
    pub(crate) refusal: Option<Status>,
    /// Number of next requests for leases before which the accounts are lost.
    pub(crate) n_losses: usize,
    /// Units charged by all accounts that there ever were, lost ones included.
    pub(crate) charged_ever: u64,
    /// The teacher's task, unless it is that of the toy.
    pub(crate) task: Option<TaskSpec>,
    /// The digest of the teacher's policy.
    pub(crate) policy_digest: String,
    /// Every account that was opened, with its budget.
    pub(crate) opened: Vec<(String, u64)>,
}

#[derive(Default)]
pub(crate) struct Account {
    pub(crate) budget: u64,
    strategy: String,
    pub(crate) spent: u64,
    /// Units set aside for an episode, and whether it is settled.
    leases: BTreeMap<u64, (u64, bool)>,
    /// Episodes that were charged, with what.
    charges: BTreeMap<u64, u64>,
}

impl Account {
    fn left(&self) -> u64 {
        let open = self.leases.iter().filter(|(_, (_, settled))| !settled);
        let unspent = |(episode, (units, _)): (&u64, &(u64, bool))| {
            units - self.charges.get(episode).unwrap_or(&0)
        };
        self.budget - self.spent - open.map(unspent).sum::<u64>()
    }
}

impl Books {
    /// Charges an episode up to `units`; `None` when the account is unknown.
    pub(crate) fn charge(&mut self, name: &str, episode: u64, units: u64) -> Option<u64> {
        let account = self.accounts.get_mut(name)?;
        if let Some(charged) = account.charges.get(&episode) {
            return Some(*charged);
        }
        let lease = account
            .leases
            .get(&episode)
            .map_or_else(|| account.left(), |(units, settled)| if *settled { 0 } else { *units });
        let charged = units.min(lease);
        account.charges.insert(episode, charged);
        account.spent += charged;
        self.charged_ever += charged;
        Some(charged)
    }

    fn account(&mut self, name: &str) -> Result<&mut Account, Status> {
        if let Some(refusal) = &self.refusal {
            return Err(refusal.clone());
        }
        let unknown = || Status::not_found(format!("unknown account {name:?}: open it first"));
        self.accounts.get_mut(name).ok_or_else(unknown)
    }
}

impl FakeTeacher {
    /// Serves until the runtime ends; gives the address.
    pub(crate) async fn serve(&self) -> SocketAddr {
        let listener = TcpListener::bind("127.0.0.1:0").await.expect("a port");
        let address = listener.local_addr().expect("bound");
        let router = ServerConfig::default()
            .router(TeacherServer::new(self.clone()), tandem_proto::FILE_DESCRIPTOR_SET)
            .await;
        let router = router.expect("can be offered");
        tokio::spawn(tandem_net::serve(router, listener, CancellationToken::new()));
        address
    }

    pub(crate) fn books(&self) -> MutexGuard<'_, Books> {
        self.books.lock().expect("no test panics in here")
    }
}

fn message(name: &str, account: &Account) -> pb::Account {
    let left = account.left();
    pb::Account {
        name: name.to_owned(),
        budget: account.budget,
        strategy: account.strategy.clone(),
        spent: account.spent,
        leased: account.budget - account.spent - left,
        left,
        warning: String::new(),
    }
}

#[tonic::async_trait]
impl Teacher for FakeTeacher {
    type AdviseStreamStream = tokio_stream::Pending<Result<pb::AdviseResponse, Status>>;

    async fn open_account(
        &self,
        request: Request<pb::OpenAccountRequest>,
    ) -> Result<Response<pb::Account>, Status> {
        let pb::OpenAccountRequest { name, budget, strategy } = request.into_inner();
        let mut books = self.books();
        match books.account(&name) {
            Ok(open) if (open.budget, &open.strategy) == (budget, &strategy) => {
                return Ok(Response::new(message(&name, open)));
            }
            Ok(open) => {
                let told = format!("account {name:?} is open with budget {}", open.budget);
                return Err(Status::already_exists(told));
            }
            Err(status) if status.code() != tonic::Code::NotFound => return Err(status),
            Err(_) => {}
        }
        let account = Account { budget, strategy, ..Account::default() };
        let answer = message(&name, &account);
        books.opened.push((name.clone(), budget));
        books.accounts.insert(name, account);
        Ok(Response::new(answer))
    }

    async fn get_account(
        &self,
        request: Request<pb::GetAccountRequest>,
    ) -> Result<Response<pb::Account>, Status> {
        let name = request.into_inner().name;
        let mut books = self.books();
        Ok(Response::new(message(&name, books.account(&name)?)))
    }

    async fn open_leases(
        &self,
        request: Request<pb::OpenLeasesRequest>,
    ) -> Result<Response<pb::OpenLeasesResponse>, Status> {
        let pb::OpenLeasesRequest { account: name, episodes, units_per_episode } =
            request.into_inner();
        let mut books = self.books();
        if books.n_losses > 0 {
            books.n_losses -= 1;
            books.accounts.clear();
        }
        let account = books.account(&name)?;
        let mut leases = Vec::new();
        for episode in episodes {
            let units = account.left().min(u64::from(units_per_episode));
            let (units, _) = *account.leases.entry(episode).or_insert((units, false));
            let units = u32::try_from(units).expect("few");
            leases.push(pb::Lease { episode, units, early_units: 0 });
        }
        let answer = Some(message(&name, account));
        Ok(Response::new(pb::OpenLeasesResponse { leases, account: answer }))
    }

    async fn settle_leases(
        &self,
        request: Request<pb::SettleLeasesRequest>,
    ) -> Result<Response<pb::Account>, Status> {
        let pb::SettleLeasesRequest { account: name, episodes } = request.into_inner();
        let mut books = self.books();
        let account = books.account(&name)?;
        let settled: BTreeSet<u64> = episodes.into_iter().collect();
        for (episode, lease) in &mut account.leases {
            lease.1 |= settled.contains(episode);
        }
        Ok(Response::new(message(&name, account)))
    }

    async fn describe(
        &self,
        _: Request<pb::DescribeRequest>,
    ) -> Result<Response<pb::DescribeResponse>, Status> {
        let task = self.books().task.clone().unwrap_or_else(|| LAYOUT.into());
        let task_description = Some(encode_task(&task));
        let policy_digest = self.books().policy_digest.clone();
        Ok(Response::new(pb::DescribeResponse {
            task_description,
            policy_digest,
            ..Default::default()
        }))
    }

    async fn advise(
        &self,
        _: Request<pb::AdviseRequest>,
    ) -> Result<Response<pb::AdviseResponse>, Status> {
        Err(Status::unimplemented("no test asks for advice"))
    }

    async fn advise_stream(
        &self,
        _: Request<Streaming<pb::AdviseRequest>>,
    ) -> Result<Response<Self::AdviseStreamStream>, Status> {
        Err(Status::unimplemented("no test asks for advice"))
    }
}
