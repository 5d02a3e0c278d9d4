//! Displays and recordings of the arms of a bridge: logs of motions, viewers and the operator page.
//!
//! The arms' thread puts every state into a bounded queue and waits for nothing. One thread turns states into views and
//! offers them to viewers and pages; another one writes logs, so that a slow disk delays neither.

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, TrySendError, sync_channel};
use std::time::Duration;

use tandem_bridge::injection::Injector;
use tandem_bridge::service::{Observer, Operator, Snapshots, observe};
use tandem_core::text::error_chain;
use tandem_dashboard::{Access, BridgeTerms, ConfirmedStop, Site, StopAction};
use tandem_kinematics::WorkCell;
use tandem_net::{ServerConfig, Token};
use tandem_system::{DirectoryLock, atomic_file};
use tandem_telemetry::live::LiveArms;
use tandem_telemetry::{ArmsView, MotionJournal};
use tokio::net::TcpListener;
use tokio::sync::watch;
use tokio_util::sync::{CancellationToken, DropGuard};

use super::cell::Cell;
use super::{arms, view};
use crate::cli::BridgeServeArgs;
use crate::exit::{Exit, Failed, OrExit as _};
use crate::version::VERSION;
use crate::{access, dashboard, output, run_directory};

/// States that wait for the thread that views them, about ten seconds. Further ones are lost and counted.
const QUEUE_CAPACITY: usize = 1024;
/// Time between two states for viewers and for pages, seconds.
const LIVE_EVERY_S: f64 = 0.045;
const PAGE_EVERY_S: f64 = 0.095;
/// Niceness of the threads, which the arms' thread precedes on a busy machine.
const NICENESS: i32 = 10;
/// Time that the end of the bridge waits for its last log.
const END_TIMEOUT: Duration = Duration::from_secs(2);

/// Everything that the command line asks for, before the arms are ticked.
pub(super) struct Plan {
    journal: Option<(MotionJournal, DirectoryLock)>,
    live: Option<LiveArms>,
    page: Option<Page>,
}

/// A bound page.
struct Page {
    listener: TcpListener,
    address: SocketAddr,
    access: Access,
}

/// The running threads. The page ends when this value is dropped.
pub(super) struct Watching {
    ended: Option<Receiver<()>>,
    _page: Option<DropGuard>,
}

/// Listens for viewers, if the command line asks for it. Must not be called within a runtime.
pub(super) fn live(args: &BridgeServeArgs, n_arms: usize) -> Result<Option<LiveArms>, Failed> {
    let Some(address) = args.live.live else { return Ok(None) };
    let live = LiveArms::start(address, n_arms);
    let live = live.or_exit(Exit::TryAgain, String::new)?;
    output::message(format_args!("tandem: live on ws://{}", live.address()));
    Ok(Some(live))
}

impl Plan {
    /// Creates the directory of logs and listens for pages.
    pub(super) async fn of(
        args: &BridgeServeArgs,
        cell: &Cell,
        server_config: &ServerConfig,
        live: Option<LiveArms>,
    ) -> Result<Self, Failed> {
        let access = page_access(args, server_config.token())?;
        let journal = args.record.as_ref().map(|directory| {
            atomic_file::create_directory(directory)
                .or_cannot_write(|| format!("cannot create {}", directory.display()))?;
            // The logs of two bridges could have the same names, and each deletes old ones.
            let lock = run_directory::lock_for("--record", directory)?;
            let journal = MotionJournal::create(directory, args.log_budget.0, metadata(args, cell));
            Ok((journal.map_err(Failed::of_write)?, lock))
        });
        let journal = journal.transpose()?;
        let page = match access {
            Some((address, access)) => {
                bind(address, access, args.dashboard.dashboard.is_none()).await?
            }
            None => None,
        };
        Ok(Self { journal, live, page })
    }

    /// Returns a queue of states if anything shows or records them.
    pub(super) fn observer(&self) -> (Option<Observer>, Option<Snapshots>) {
        if self.journal.is_none() && self.live.is_none() && self.page.is_none() {
            return (None, None);
        }
        let (observer, snapshots) = observe(QUEUE_CAPACITY);
        (Some(observer), Some(snapshots))
    }

    /// Starts the threads and serves the page.
    pub(super) fn start(
        self,
        args: &BridgeServeArgs,
        operator: &Operator,
        injector: Option<Injector>,
        snapshots: Option<Snapshots>,
    ) -> Result<Watching, Failed> {
        let Some(snapshots) = snapshots else { return Ok(Watching { ended: None, _page: None }) };
        let before = ArmsView { is_connected: true, ..ArmsView::default() };
        let (views, receiver) = watch::channel(Arc::new(before));
        let page = self.page.map(|page| page.serve(args, operator, receiver));
        let (end, ended) = sync_channel(1);
        let journal = match self.journal {
            Some((journal, lock)) => {
                let (queue, waiting) = sync_channel(QUEUE_CAPACITY);
                spawn("recorder", move || {
                    record(journal, &waiting);
                    drop(lock);
                    // Fails only if the bridge has not waited.
                    end.send(()).ok();
                })?;
                Some(queue)
            }
            None => None,
        };
        let (cell, live) = (operator.cell().clone(), self.live);
        let viewer = Viewer { cell, injector, journal, live, views, has_lost: false };
        spawn("viewer", move || viewer.run(snapshots))?;
        Ok(Watching { ended: Some(ended), _page: page })
    }
}

impl Watching {
    /// Waits until the last log is complete, at most two seconds. The arms' thread must have ended.
    pub(super) fn finish(self) {
        if let Some(ended) = self.ended
            && ended.recv_timeout(END_TIMEOUT) == Err(RecvTimeoutError::Timeout)
        {
            tracing::warn!("the last log is not complete: `tandem mcap recover` recovers it");
        }
    }
}

/// The thread that views states.
struct Viewer {
    cell: WorkCell,
    /// The injected faults of simulated arms.
    injector: Option<Injector>,
    journal: Option<SyncSender<Arc<ArmsView>>>,
    live: Option<LiveArms>,
    views: watch::Sender<Arc<ArmsView>>,
    has_lost: bool,
}

impl Viewer {
    fn run(mut self, mut snapshots: Snapshots) {
        let (mut live_s, mut page_s) = (f64::NEG_INFINITY, f64::NEG_INFINITY);
        let mut phase = None;
        while let Some(snapshot) = snapshots.wait() {
            let is_new = phase.replace(snapshot.phase) != Some(snapshot.phase);
            let is_due = |since_s: f64, every_s: f64| is_new || snapshot.now_s - since_s >= every_s;
            let for_live = self.live.is_some() && is_due(live_s, LIVE_EVERY_S);
            let for_page = is_due(page_s, PAGE_EVERY_S);
            if self.journal.is_none() && !for_live && !for_page {
                continue;
            }
            let view = Arc::new(view::of(&snapshot, &self.cell, self.injector.as_ref()));
            if let (Some(live), true) = (&mut self.live, for_live) {
                live_s = view.time_s;
                live.publish(&view);
            }
            if for_page {
                page_s = view.time_s;
                self.views.send_replace(Arc::clone(&view));
            }
            self.record(view, snapshots.n_lost());
        }
        if let Some(live) = self.live.take() {
            live.stop();
        }
    }

    /// Queues a state for its log. What the disk does not take in time is lost.
    fn record(&mut self, view: Arc<ArmsView>, n_lost: u64) {
        let Some(journal) = &self.journal else { return };
        let is_full = matches!(journal.try_send(view), Err(TrySendError::Full(_)));
        if (is_full || n_lost > 0) && !std::mem::replace(&mut self.has_lost, true) {
            tracing::warn!("recording falls behind: states are missing in the logs");
        }
    }
}

/// Writes logs until the sender of states is gone.
fn record(mut journal: MotionJournal, views: &Receiver<Arc<ArmsView>>) {
    for view in views {
        journal.record(&view);
    }
    journal.finish();
}

impl Page {
    /// Serves the page until the returned value is dropped.
    fn serve(
        self,
        args: &BridgeServeArgs,
        operator: &Operator,
        views: watch::Receiver<Arc<ArmsView>>,
    ) -> DropGuard {
        let settings = operator.settings();
        let terms = BridgeTerms {
            driver: arms::name(args.arms.driver).to_owned(),
            version: VERSION.to_owned(),
            table_z_m: operator.cell().table_z_m,
            speed: args.speed,
            table_gap_m: settings.table_gap_m,
            arms_gap_m: settings.arms_gap_m,
            self_gap_m: settings.self_gap_m,
        };
        output::message(format_args!("dashboard on {}", dashboard::url(self.address)));
        let site = Site::of_bridge(terms, views, stop_action(operator.clone()));
        let stop = CancellationToken::new();
        drop(tokio::spawn(dashboard::serve(site, self.access, self.listener, stop.clone())));
        stop.drop_guard()
    }
}

/// Returns the action of the stop button, which is the one of `tandem bridge stop`.
fn stop_action(operator: Operator) -> StopAction {
    Arc::new(move || {
        let operator = operator.clone();
        Box::pin(async move {
            tracing::info!("the stop button of the page was pressed");
            let stopped = operator.stop().await.map_err(|error| error_chain(&error))?;
            let stopped = stopped
                .map(|stop| ConfirmedStop { stopped: stop.to_string(), time_s: stop.when_s });
            Ok(stopped.unwrap_or_default())
        })
    })
}

/// Binds the page's address or the next free one. Without an address on the command line, a bridge serves without a page
/// if there is none.
async fn bind(
    address: SocketAddr,
    access: Access,
    is_optional: bool,
) -> Result<Option<Page>, Failed> {
    let bound = dashboard::bind_free(address).await;
    let bound = bound.and_then(|listener| Ok((listener.local_addr()?, listener)));
    match bound {
        Ok((address, listener)) => Ok(Some(Page { listener, address, access })),
        Err(error) if is_optional => {
            tracing::warn!(%address, %error, "no dashboard: the address cannot be listened on");
            Ok(None)
        }
        Err(error) => {
            let cannot = || format!("cannot listen on {address} for --dashboard");
            Err(error).or_exit(Exit::TryAgain, cannot)
        }
    }
}

/// Returns the address of the page and who may see it. The token of the bridge protects the page too.
fn page_access(
    args: &BridgeServeArgs,
    token: Option<&Token>,
) -> Result<Option<(SocketAddr, Access)>, Failed> {
    if args.dashboard.no_dashboard {
        return Ok(None);
    }
    let address = args.dashboard.dashboard.unwrap_or_else(dashboard::default_address);
    let own = args.dashboard.dashboard_token_file.as_deref().map(access::read_token).transpose()?;
    let rules = match own.as_ref().or(token) {
        Some(token) => Access::with_token(token.clone()),
        None => dashboard::access("--dashboard", address, None, args.listen.insecure)?,
    };
    Ok(Some((address, rules)))
}

/// Returns the metadata of all logs: the bridge, its arms and their limits.
fn metadata(args: &BridgeServeArgs, file: &Cell) -> BTreeMap<String, String> {
    let cell = file.file.work_cell();
    let settings = file.settings(args.arms.driver);
    let timings = file.file.timings(&arms::default_settings(args.arms.driver));
    let mut metadata = BTreeMap::new();
    let mut add = |key: &str, value: String| drop(metadata.insert(key.to_owned(), value));
    add("driver", arms::name(args.arms.driver).to_owned());
    add("version", VERSION.to_owned());
    add("speed_limit", args.speed.to_string());
    add("arms", cell.arms.len().to_string());
    add("table_z_m", cell.table_z_m.to_string());
    for (idx, placed) in cell.arms.iter().enumerate() {
        let base = placed.base_in_world_m;
        add(&format!("arm{idx}.model"), placed.model.name.to_owned());
        add(&format!("arm{idx}.base_m"), format!("{} {} {}", base.x, base.y, base.z));
        add(&format!("arm{idx}.yaw_rad"), placed.yaw_rad.to_string());
        let (arm, timing) = (&file.file.arms[idx], timings[idx]);
        add(&format!("arm{idx}.name"), arm.name.clone());
        add(&format!("arm{idx}.lag_s"), timing.lag_s.to_string());
        add(&format!("arm{idx}.reaction_s"), timing.reaction_s.to_string());
        add(&format!("arm{idx}.brake_s"), timing.brake_s.to_string());
        add(&format!("arm{idx}.is_measured"), arm.is_measured().to_string());
    }
    add("cell_file", file.name.clone());
    add("limit.lag_s", settings.lag_s.to_string());
    add("limit.reaction_s", settings.reaction_s.to_string());
    add("limit.brake_s", settings.brake_s.to_string());
    add("limit.tilt_rad", settings.check.tilt_rad.to_string());
    add("limit.ramp_s", settings.check.limits.ramp_s.to_string());
    add("limit.check_table_gap_m", settings.check.table_gap_m.to_string());
    add("limit.check_arms_gap_m", settings.check.arms_gap_m.to_string());
    add("limit.check_self_gap_m", settings.check.self_gap_m.to_string());
    add("limit.table_gap_m", settings.table_gap_m.to_string());
    add("limit.arms_gap_m", settings.arms_gap_m.to_string());
    add("limit.self_gap_m", settings.self_gap_m.to_string());
    add("limit.tracking_rad", settings.tracking_rad.to_string());
    add("limit.torque_nm", settings.torque_nm.to_string());
    add("limit.tool_speed_mps", settings.check.limits.tool_speed_mps.to_string());
    metadata
}

/// Starts a thread that leaves the processor to the arms' thread.
fn spawn(name: &str, work: impl FnOnce() + Send + 'static) -> Result<(), Failed> {
    let work = move || {
        // On Linux, this concerns the calling thread only. If it fails, the thread competes like any other.
        rustix::process::nice(NICENESS).ok();
        work();
    };
    let thread = std::thread::Builder::new().name(name.to_owned()).spawn(work);
    thread.map(drop).or_exit(Exit::TryAgain, || "cannot start a thread".to_owned())
}
