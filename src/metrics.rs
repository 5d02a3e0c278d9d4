//! The metrics of a service's process, and the page that serves them.

use std::net::SocketAddr;

use tandem_net::Metrics;
use tandem_net::metrics::{ConstCounter, ConstGauge, Info, Registry};
use tandem_system::process::{ProcessUsage, ResidentMemory};
use tokio::net::TcpListener;

use crate::cli::MetricsArgs;
use crate::clock;
use crate::exit::{Exit, Failed, OrExit as _};
use crate::version::VERSION;

/// Creates the metrics of a process that runs the service `component`.
pub(crate) fn of_process(component: &'static str) -> Metrics {
    let metrics = Metrics::new(clock::since_now());
    let build = Info::new(vec![("version", VERSION), ("component", component)]);
    metrics.register("build", "Version of the program, and the service that it runs", build);
    let start_s = clock::unix_millis() as f64 / 1000.0;
    metrics.add_foreign_source(move |registry| add_process(registry, start_s));
    metrics
}

/// Adds the metrics that all programs have, by the names of Prometheus' client libraries.
fn add_process(registry: &mut Registry, start_s: f64) {
    let pid = std::process::id();
    let cpu = ConstCounter::new(ProcessUsage::of(pid).cpu_s);
    registry.register("process_cpu_seconds", "Processor time of all threads", cpu);
    let resident_bytes = (ResidentMemory::of(pid).current_kib * 1024) as f64;
    let help = "Resident memory";
    registry.register("process_resident_memory_bytes", help, ConstGauge::new(resident_bytes));
    let help = "Start of the process, seconds since 1970";
    registry.register("process_start_time_seconds", help, ConstGauge::new(start_s));
}

/// Checks that the address of the page is free, if there is one, and returns it with a free port in place of port 0.
pub(crate) fn free_address(args: &MetricsArgs) -> Result<Option<SocketAddr>, Failed> {
    let bind = |address| std::net::TcpListener::bind(address)?.local_addr();
    let free = |address| bind(address).or_exit(Exit::TryAgain, || cannot_listen(address));
    args.metrics_listen.map(free).transpose()
}

fn cannot_listen(address: SocketAddr) -> String {
    format!("cannot listen on {address} for --metrics-listen")
}

/// Binds the address of the page, if there is one.
pub(crate) async fn listen(args: &MetricsArgs) -> Result<Option<TcpListener>, Failed> {
    let Some(address) = args.metrics_listen else { return Ok(None) };
    let bound = TcpListener::bind(address).await;
    let listener = bound.or_exit(Exit::TryAgain, || cannot_listen(address))?;
    if let Ok(address) = listener.local_addr() {
        tracing::info!(%address, "serving Prometheus metrics, without a token");
    }
    Ok(Some(listener))
}

/// Serves the page, if it has an address, until the process ends.
pub(crate) async fn serve(args: &MetricsArgs, metrics: &Metrics) -> Result<(), Failed> {
    if let Some(listener) = listen(args).await? {
        tokio::spawn(metrics.endpoint().serve(listener));
    }
    Ok(())
}
