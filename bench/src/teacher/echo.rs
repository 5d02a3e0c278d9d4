//! A teacher service that returns a constant response, to measure the cost of the messages alone.

use std::pin::Pin;

use tandem_net::ServerConfig;
use tandem_proto::pb;
use tandem_proto::pb::teacher_server::{Teacher, TeacherServer};
use tokio::net::TcpListener;
use tokio_stream::{Stream, StreamExt as _};
use tokio_util::sync::CancellationToken;
use tonic::{Request, Response, Status, Streaming};

use crate::Error;

/// Responds to every request with `response` until `shutdown` is cancelled.
pub(super) async fn serve(
    response: pb::AdviseResponse,
    listener: TcpListener,
    shutdown: CancellationToken,
) -> Result<(), Error> {
    let router = ServerConfig::default()
        .router(TeacherServer::new(Echo { response }), tandem_proto::FILE_DESCRIPTOR_SET)
        .await?;
    Ok(tandem_net::serve(router, listener, shutdown).await?)
}

struct Echo {
    response: pb::AdviseResponse,
}

#[tonic::async_trait]
impl Teacher for Echo {
    type AdviseStreamStream =
        Pin<Box<dyn Stream<Item = Result<pb::AdviseResponse, Status>> + Send>>;

    async fn advise(
        &self,
        _: Request<pb::AdviseRequest>,
    ) -> Result<Response<pb::AdviseResponse>, Status> {
        Ok(Response::new(self.response.clone()))
    }

    async fn advise_stream(
        &self,
        requests: Request<Streaming<pb::AdviseRequest>>,
    ) -> Result<Response<Self::AdviseStreamStream>, Status> {
        let response = self.response.clone();
        let responses = requests.into_inner().map(move |request| request.map(|_| response.clone()));
        Ok(Response::new(Box::pin(responses)))
    }

    async fn describe(
        &self,
        _: Request<pb::DescribeRequest>,
    ) -> Result<Response<pb::DescribeResponse>, Status> {
        Err(Status::unimplemented("not supported by the echo service"))
    }

    async fn open_account(
        &self,
        _: Request<pb::OpenAccountRequest>,
    ) -> Result<Response<pb::Account>, Status> {
        Err(Status::unimplemented("not supported by the echo service"))
    }

    async fn get_account(
        &self,
        _: Request<pb::GetAccountRequest>,
    ) -> Result<Response<pb::Account>, Status> {
        Err(Status::unimplemented("not supported by the echo service"))
    }

    async fn open_leases(
        &self,
        _: Request<pb::OpenLeasesRequest>,
    ) -> Result<Response<pb::OpenLeasesResponse>, Status> {
        Err(Status::unimplemented("not supported by the echo service"))
    }

    async fn settle_leases(
        &self,
        _: Request<pb::SettleLeasesRequest>,
    ) -> Result<Response<pb::Account>, Status> {
        Err(Status::unimplemented("not supported by the echo service"))
    }
}
