//! `tandem health`: checks the health of a service, for operators, containers and probes.

use serde_json::json;
use tandem_net::check_health;

use crate::cli::HealthArgs;
use crate::exit::{Exit, Failed, OrExit as _};
use crate::{access, output, runtime};

pub(crate) fn health(args: &HealthArgs) -> Result<(), Failed> {
    let HealthArgs { address, service, .. } = args;
    let client_config = access::client_config_without_token(&args.client_config)?;
    let runtime = runtime::new().or_exit(Exit::TryAgain, String::new)?;
    let answer = runtime.block_on(async {
        let link = client_config.channel(address).or_exit(Exit::Usage, String::new)?;
        Ok(check_health(link, service, args.timeout_s).await)
    })?;
    if args.json {
        let reason = answer.as_ref().err().map(ToString::to_string);
        let serving = answer.is_ok();
        let shown =
            json!({"address": address, "service": service, "serving": serving, "reason": reason});
        output::print(shown)?;
    } else if answer.is_ok() {
        output::print("serving")?;
    }
    let says_where = answer.as_ref().is_err_and(|unwell| unwell.to_string().starts_with(address));
    answer.or_exit(Exit::TryAgain, || if says_where { String::new() } else { address.clone() })
}
