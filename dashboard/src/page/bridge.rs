//! The page of a bridge.

use maud::{Markup, html};

use super::{Page, card, document, views};

/// Returns the page of a bridge. The stop button is the first element that the keyboard reaches.
pub(crate) fn bridge() -> Page {
    let body = html! {
        div .stop-bar {
            button #stop .stop type="button" aria-describedby="stop-result" { "Stop both arms" }
            p #stop-result .stop-result role="alert" {}
        }
        header .top {
            div .title {
                p .brand { "Tandem bridge" }
                h1 #phase-title { "Connecting" }
                p #terms .terms {}
            }
            div .state {
                p #status role="status" aria-live="polite" {
                    span #phase .badge { "connecting" }
                    " "
                    span #link .link { "connecting" }
                    " "
                    span #age .link.lost aria-hidden="true" {}
                }
                p #clock .clock {}
            }
        }
        noscript {
            p .alert { "This page needs JavaScript. Stop the arms with `tandem bridge stop`." }
        }
        main #content {
            p #alert .alert role="alert" hidden {}
            (card("motion", "Motion", &motion()))
            section aria-label="Current values" { dl #tiles .tiles {} }
            div .columns {
                (card("arms", "Both arms, live", &views("arms-text")))
                div .stack {
                    (card("last-stop", "Last stop", &html! { p #last-stop { "–" } p #last-stop-time .note {} }))
                    (card("events", "Recent events", &html! { ol #log .log tabindex="0" {} }))
                }
            }
            (card("joints", "Joints", &html! {
                div .scroll tabindex="0" role="region" aria-label="Joints" { table #joint-table {} }
            }))
        }
        footer {
            p {
                "The button stops the arms as `tandem bridge stop` does. It is no emergency stop: a program can fail. "
                "Inspect the arms before `tandem bridge reset`."
            }
        }
    };
    document("Tandem bridge", "bridge.js", &body)
}

fn motion() -> Markup {
    html! {
        p #motion-text { "–" }
        div #progress .progress role="progressbar" aria-labelledby="motion-heading"
            aria-valuemin="0" aria-valuemax="100" { div #bar .bar {} }
    }
}
