//! The HTML of the pages and the files that it refers to. Scripts fill in the data.

use maud::{DOCTYPE, Markup, PreEscaped, html};
use sha2::{Digest as _, Sha256};

pub(crate) use bridge::bridge;

mod bridge;

/// Icon of the pages: two arms that meet.
const ICON: &str = "data:image/svg+xml,%3Csvg xmlns='http://www.w3.org/2000/svg' viewBox='0 0 32 32'%3E%3Crect width='32' height='32' rx='7' fill='%230072B2'/%3E%3Cpath d='M5 24 11 9l5 8 5-8 6 15' fill='none' stroke='white' stroke-width='3' stroke-linejoin='round' stroke-linecap='round'/%3E%3Ccircle cx='16' cy='17' r='2.6' fill='%23E69F00'/%3E%3C/svg%3E";

/// The files that pages refer to: name, content type and content.
pub(crate) const ASSETS: [(&str, &str, &str); 8] = [
    ("style.css", "text/css; charset=utf-8", include_str!("../assets/style.css")),
    ("common.js", "text/javascript; charset=utf-8", include_str!("../assets/common.js")),
    ("chart.js", "text/javascript; charset=utf-8", include_str!("../assets/chart.js")),
    ("player.js", "text/javascript; charset=utf-8", include_str!("../assets/player.js")),
    ("run.js", "text/javascript; charset=utf-8", include_str!("../assets/run.js")),
    ("bridge.js", "text/javascript; charset=utf-8", include_str!("../assets/bridge.js")),
    ("sweep.js", "text/javascript; charset=utf-8", include_str!("../assets/sweep.js")),
    ("login.js", "text/javascript; charset=utf-8", include_str!("../assets/login.js")),
];

/// A page.
pub(crate) struct Page {
    /// The HTML text.
    pub(crate) html: String,
    /// Changes with every change of the page and its files. Scripts find it in the HTML text.
    pub(crate) id: String,
}

/// Returns the page of a run.
pub(crate) fn run() -> Page {
    let body = html! {
        (header("Run", "This page needs JavaScript. `tandem status` shows the same values."))
        main #content {
            p #alert .alert role="alert" hidden {}
            section .now aria-label="Current values" { dl #tiles .tiles {} }
            div .columns {
                div .stack {
                    (card("success", "Success in evaluations", &html! {
                        div #success-chart .chart {}
                        (table("success-table", "Evaluations"))
                    }))
                    (card("events", "Recent events", &html! { ol #log .log tabindex="0" {} }))
                }
                (card("episode", "Latest evaluation episode", &episode()))
            }
            div .columns.three {
                (card("q", "Mean Q", &html! { div #q-chart .chart {} }))
                (card("losses", "Losses", &html! { div #loss-chart .chart {} }))
                (card("advice-spent", "Advice spent", &html! { div #advice-chart .chart {} }))
            }
            div .columns {
                (card("advice", "Advice", &html! { div #shares .shares {} }))
                (card("services", "Teacher and ledger", &html! { ul #services .services {} }))
            }
            (card("workers", "Workers", &html! {
                p #worker-summary .note {}
                ul #worker-tiles .workers {}
            }))
        }
        footer { p { "Times are the run’s own, summed over resumed parts." } }
    };
    document("Tandem run", "run.js", &body)
}

/// Returns the page of a sweep.
pub(crate) fn sweep() -> Page {
    let body = html! {
        (header("Sweep", "This page needs JavaScript. `tandem report DIRECTORY` prints the same values."))
        main #content {
            section .now aria-label="Current values" { dl #tiles .tiles {} }
            (card("success", "Success in evaluations, mean over seeds", &html! {
                p #task-field .controls hidden { label { "Task " select #task {} } }
                div #success-chart .chart {}
                (table("groups", "Latest evaluations"))
            }))
            (card("runs", "Runs", &html! { ul #run-list .runs {} }))
            (card("events", "Recent events", &html! { ol #log .log tabindex="0" {} }))
        }
        footer { p { "Bands reach from the lowest to the highest seed. Success is that of the policy alone." } }
    };
    document("Tandem sweep", "sweep.js", &body)
}

/// Returns the page that asks for the token.
pub(crate) fn login() -> Page {
    let body = html! {
        main .login {
            h1 { "Tandem" }
            form #login {
                label for="token" { "Access token of this service" }
                input #token type="password" autocomplete="current-password" required;
                button type="submit" { "Open" }
                p #login-error .error role="alert" {}
            }
        }
    };
    document("Tandem", "login.js", &body)
}

/// Returns the head of a page that shows something `what` by scripts; without scripts, it shows `instead`.
fn header(what: &str, instead: &str) -> Markup {
    html! {
        a .skip href="#content" { "Skip to the values" }
        header .top {
            div .title {
                p .brand { "Tandem" }
                h1 #name { (what) }
                p #terms .terms {}
            }
            div .state {
                p #status role="status" aria-live="polite" {
                    span #phase .badge { "connecting" }
                    " "
                    span #link .link { "connecting" }
                }
                p #clock .clock {}
            }
            div #progress .progress role="progressbar" aria-label="Progress"
                aria-valuemin="0" aria-valuemax="100" { div #bar .bar {} }
            p #progress-text .note {}
        }
        noscript { p .alert { (instead) } }
    }
}

/// Returns two views of the arms, with a paragraph `text_id` that describes them.
fn views(text_id: &str) -> Markup {
    html! {
        div .views {
            figure {
                figcaption { "From above" }
                svg #view-above role="img" aria-labelledby=(text_id) {}
            }
            figure {
                figcaption { "From the side" }
                svg #view-side role="img" aria-labelledby=(text_id) {}
            }
        }
        p id=(text_id) .note {}
    }
}

/// Returns the two views of an episode and its controls.
fn episode() -> Markup {
    html! {
        p #episode-note .note {}
        div #player hidden {
            (views("episode-text"))
            div .controls {
                button #play type="button" { "Play" }
                input #step type="range" min="0" max="50" value="0" aria-label="Step of the episode";
                label { "Episode " select #episode-choice {} }
            }
        }
    }
}

fn card(id: &str, title: &str, content: &Markup) -> Markup {
    let heading = format!("{id}-heading");
    html! {
        section .card aria-labelledby=(heading) {
            h2 id=(heading) { (title) }
            (content)
        }
    }
}

/// Returns a table that is folded until it is asked for.
fn table(id: &str, caption: &str) -> Markup {
    html! {
        details {
            summary { "Values as a table" }
            div .scroll tabindex="0" role="region" aria-label=(caption) { table id=(id) {} }
        }
    }
}

fn document(title: &str, script: &str, body: &Markup) -> Page {
    let id = id_of(&[title, script, &body.0]);
    let markup = html! {
        (DOCTYPE)
        html lang="en" data-page=(id) {
            head {
                meta charset="utf-8";
                meta name="viewport" content="width=device-width, initial-scale=1";
                meta name="color-scheme" content="light dark";
                title { (title) }
                link rel="icon" href=(PreEscaped(ICON));
                link rel="stylesheet" href="/assets/style.css";
                script type="module" src=(format!("/assets/{script}")) {}
            }
            body { (body) }
        }
    };
    Page { html: markup.into_string(), id }
}

/// Returns the identity of a page of these `parts`.
fn id_of(parts: &[&str]) -> String {
    let mut digest = Sha256::new();
    let files = ASSETS.iter().map(|(.., content)| *content);
    for text in parts.iter().copied().chain(files) {
        digest.update(text.len().to_le_bytes());
        digest.update(text);
    }
    digest.finalize().iter().take(8).map(|byte| format!("{byte:02x}")).collect()
}
