//! A teacher whose advice depends on the request alone, on a stream that fails at configured requests.

use std::collections::BTreeSet;
use std::sync::Arc;
use std::sync::Mutex;

use tandem_core::{ArmAdvice, StepAdvice, StepQuery};
use tandem_proto::pb;
use tokio::sync::mpsc;
use tokio_stream::StreamExt as _;
use tokio_stream::wrappers::ReceiverStream;
use tonic::{Code, Request, Response, Status, Streaming};

use super::{LAYOUT, terms};

#[derive(Default)]
pub(crate) struct FakeTeacher(Arc<Inner>);

#[derive(Default)]
struct Inner {
    n_requests: Mutex<usize>,
    charged: Mutex<BTreeSet<(u64, u32)>>,
    faults: Vec<(usize, Fault)>,
}

enum Fault {
    /// The stream ends with this status.
    End(Status),
    /// The request gets no response.
    Hang(mpsc::Sender<()>),
    /// The response follows this message.
    Signal(mpsc::Sender<()>),
    /// The response lacks the last step.
    Forget,
}

impl FakeTeacher {
    /// Ends the stream at these requests, counted from 0 over all streams.
    pub(crate) fn failing_at(self, requests: [usize; 4], status: &Status) -> Self {
        Self::with_faults(requests.map(|nth| (nth, Fault::End(status.clone()))).into())
    }

    /// Leaves a request without a response. The receiver gets a message when the request arrives.
    pub(crate) fn hanging_at(self, nth: usize) -> (Self, mpsc::Receiver<()>) {
        let (reached, at_fault) = mpsc::channel(1);
        (Self::with_faults(vec![(nth, Fault::Hang(reached))]), at_fault)
    }

    /// Answers a request. The receiver gets a message when the request arrives.
    pub(crate) fn signalling_at(self, nth: usize) -> (Self, mpsc::Receiver<()>) {
        let (reached, at_fault) = mpsc::channel(1);
        (Self::with_faults(vec![(nth, Fault::Signal(reached))]), at_fault)
    }

    /// Omits the last step of a response.
    pub(crate) fn forgetful_at(self, nth: usize) -> Self {
        Self::with_faults(vec![(nth, Fault::Forget)])
    }

    fn with_faults(faults: Vec<(usize, Fault)>) -> Self {
        Self(Arc::new(Inner { faults, ..Inner::default() }))
    }

    /// Returns the units charged to an episode.
    pub(crate) fn n_charged(&self, episode: u64) -> u32 {
        let charged = self.0.charged.lock().expect("no handler panics");
        charged.iter().map(|(charged_to, _)| u32::from(*charged_to == episode)).sum()
    }
}

impl Inner {
    fn answer(&self, request: pb::AdviseRequest) -> Result<pb::AdviseResponse, Status> {
        assert_eq!(Some(request.account), terms().account);
        let verdict = |query| Ok(self.verdict(&tandem_proto::decode_query(query, LAYOUT)?));
        let advice: Vec<StepAdvice> =
            request.steps.into_iter().map(verdict).collect::<Result<_, Status>>()?;
        Ok(pb::AdviseResponse {
            steps: advice.iter().map(tandem_proto::encode_advice).collect(),
            budget_left: 0,
        })
    }

    /// Overrides the first arm where its hand is on one side of the workspace, the second on every fifth step.
    fn verdict(&self, query: &StepQuery) -> StepAdvice {
        let overrides = [query.observation[0] > 0.0, query.step.is_multiple_of(5)];
        let mut action = query.proposed_action.clone();
        for (part, _) in action.chunks_mut(3).zip(overrides).filter(|(_, overridden)| *overridden) {
            part.copy_from_slice(&[0.5, -0.5, 0.25]);
        }
        let arm = |overridden| ArmAdvice {
            teacher_action: vec![0.5, -0.5, 0.25],
            q_teacher: -1.0,
            q_student: -2.0,
            importance: 1.0,
            distance: 1.0,
            overridden,
        };
        let charged = overrides.contains(&true);
        if charged {
            self.charged.lock().expect("no handler panics").insert((query.episode, query.step));
        }
        StepAdvice { action, charged, arms: overrides.map(arm).to_vec(), repeated: false }
    }

    fn next_fault(&self) -> Option<&Fault> {
        let mut n_requests = self.n_requests.lock().expect("no handler panics");
        let nth = *n_requests;
        *n_requests += 1;
        self.faults.iter().find(|(at, _)| *at == nth).map(|(_, fault)| fault)
    }

    async fn serve(
        &self,
        mut requests: Streaming<pb::AdviseRequest>,
        answers: mpsc::Sender<Result<pb::AdviseResponse, Status>>,
    ) {
        while let Some(Ok(request)) = requests.next().await {
            let mut answer = self.answer(request);
            match self.next_fault() {
                None => {}
                Some(Fault::End(status)) if status.code() == Code::Ok => return,
                Some(Fault::End(status)) => {
                    answers.send(Err(status.clone())).await.ok();
                    return;
                }
                Some(Fault::Hang(reached)) => {
                    reached.send(()).await.ok();
                    std::future::pending::<()>().await;
                }
                Some(Fault::Signal(reached)) => {
                    reached.send(()).await.ok();
                }
                Some(Fault::Forget) => {
                    answer.as_mut().map(|answer| answer.steps.pop()).ok();
                }
            }
            if answers.send(answer).await.is_err() {
                return;
            }
        }
    }
}

#[tonic::async_trait]
impl pb::teacher_server::Teacher for FakeTeacher {
    type AdviseStreamStream = ReceiverStream<Result<pb::AdviseResponse, Status>>;

    async fn advise_stream(
        &self,
        request: Request<Streaming<pb::AdviseRequest>>,
    ) -> Result<Response<Self::AdviseStreamStream>, Status> {
        let (answers, outgoing) = mpsc::channel(1);
        let inner = Arc::clone(&self.0);
        tokio::spawn(async move { inner.serve(request.into_inner(), answers).await });
        Ok(Response::new(ReceiverStream::new(outgoing)))
    }

    async fn advise(
        &self,
        _request: Request<pb::AdviseRequest>,
    ) -> Result<Response<pb::AdviseResponse>, Status> {
        Err(Status::unimplemented("not needed here"))
    }

    async fn describe(
        &self,
        _request: Request<pb::DescribeRequest>,
    ) -> Result<Response<pb::DescribeResponse>, Status> {
        Err(Status::unimplemented("not needed here"))
    }

    async fn open_account(
        &self,
        _request: Request<pb::OpenAccountRequest>,
    ) -> Result<Response<pb::Account>, Status> {
        Err(Status::unimplemented("not needed here"))
    }

    async fn get_account(
        &self,
        _request: Request<pb::GetAccountRequest>,
    ) -> Result<Response<pb::Account>, Status> {
        Err(Status::unimplemented("not needed here"))
    }

    async fn open_leases(
        &self,
        _request: Request<pb::OpenLeasesRequest>,
    ) -> Result<Response<pb::OpenLeasesResponse>, Status> {
        Err(Status::unimplemented("not needed here"))
    }

    async fn settle_leases(
        &self,
        _request: Request<pb::SettleLeasesRequest>,
    ) -> Result<Response<pb::Account>, Status> {
        Err(Status::unimplemented("not needed here"))
    }
}
