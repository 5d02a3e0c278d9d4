#!/usr/bin/env bash
# Uses the built program as a user would and checks its files with independent programs.
# Needs Python 3 with venv; installs the packages of scripts/requirements.txt into a temporary environment.
set -euo pipefail
cd "$(dirname "$0")/.."
cargo build --release --locked
tandem=$(realpath "${CARGO_TARGET_DIR:-target}")/release/tandem
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT

expect() { # expect CODE WORD COMMAND...: the exit code, and one line that has the word in it
  local code=$1 word=$2 got=0
  shift 2
  "$@" >"$work/out" 2>"$work/err" || got=$?
  if [ "$got" != "$code" ] || ! grep -q -- "$word" "$work/err"; then
    echo "expected exit code $code and \"$word\" from: $*; got $got:"
    cat "$work/err"
    exit 1
  fi
}

echo '- wrong input gets one clear line and the right exit code'
expect 64 'unexpected argument' "$tandem" train --no-such-flag
expect 64 'ddpg.discont' "$tandem" train --set ddpg.discont=0.9 --out "$work/none"
expect 64 'cannot read run file' "$tandem" train --run "$work/missing.toml"
expect 65 'missing.safetensors' "$tandem" eval --policy "$work/missing.safetensors"
head -c 1000 policies/teacher-push.safetensors >"$work/torn.safetensors"
head -c 1000 onnx/tests/pytorch/sb3-actor.dynamo.onnx >"$work/torn.onnx"
expect 65 'not a complete ONNX file' "$tandem" policy show "$work/torn.onnx"
expect 65 'torn.safetensors' "$tandem" eval --policy "$work/torn.safetensors"
expect 64 'holds a run already' bash -c "mkdir -p '$work/taken' && touch '$work/taken/run.toml' && '$tandem' train --out '$work/taken'"

echo '- a short advised run, start to end'
"$tandem" train --max-env-steps 4000 --seed 3 --workers 2 --out "$work/run" --json \
  --set evaluation.episodes=16 --set evaluation.every_env_steps=1600 --set ddpg.n_hidden=64 >"$work/summary.json"
python3 - "$work/summary.json" <<'PY'
import json, sys
summary = json.loads(open(sys.argv[1]).read().splitlines()[-1])
fields = "task arms episodes success_without_contact success_without_contact_low success_without_contact_high success " \
         "success_low success_high success_joint success_per_arm arm_contact_rate table_contact_rate collision_rate mean_return " \
         "policy_digest env_steps updates wall_s advice_spent budget_left run_dir policy digest".split()
missing = [field for field in fields if field not in summary]
assert not missing, f"summary lacks {missing}"
assert summary["env_steps"] == 4000 and summary["updates"] == 4000, summary
assert summary["advice_spent"] + summary["budget_left"] == 500000, summary
assert 0 < summary["advice_spent"] <= 1200, summary
PY
ls "$work/run/run.toml" "$work/run/metrics.jsonl" "$work/run/curve.svg" "$work/run/report.html" "$work/run/policy/best.safetensors" >/dev/null

echo '- the same run with another number of workers ends with the same digest'
"$tandem" train --max-env-steps 4000 --seed 3 --workers 1 --out "$work/again" --json \
  --set evaluation.episodes=16 --set evaluation.every_env_steps=1600 --set ddpg.n_hidden=64 >"$work/again.json"
python3 - "$work/summary.json" "$work/again.json" <<'PY'
import json, sys
first, second = (json.loads(open(path).read().splitlines()[-1])["digest"] for path in sys.argv[1:])
assert first == second, f"{first} != {second}"
PY

echo '- a run advised by a network that PyTorch exported'
foreign=onnx/tests/pytorch/normalized-tanh-actor.dynamo.onnx
expect 64 'has no critic' "$tandem" train --world classic --teacher "$foreign" --out "$work/foreign"
"$tandem" train --world classic --teacher "$foreign" --strategy ea --max-env-steps 2000 --workers 1 --out "$work/foreign" --json \
  --set evaluation.episodes=8 --set evaluation.every_env_steps=1600 --set ddpg.n_hidden=16 >"$work/foreign.json"
grep -q '"advice_spent":[1-9]' "$work/foreign.json"
cmp "$foreign" "$work/foreign/policy/teacher.onnx"

echo '- other programs read what it wrote'
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet --requirement scripts/requirements.txt
"$work/venv/bin/python" scripts/read_mcap.py "$work"/run/mcap/*.mcap
cargo run --release --locked --quiet -p tandem-policy --example policy_probe -- policies/teacher-push.safetensors >"$work/probe.json"
"$work/venv/bin/python" scripts/check_policy.py policies/teacher-push.safetensors "$work/probe.json"
for file in policies/*.safetensors; do
  name=$(basename "$file" .safetensors)
  "$tandem" policy export "$file" --onnx "$work/actor.onnx" --critic-onnx "$work/critic.onnx" >/dev/null
  cargo run --release --locked --quiet -p tandem-policy --example policy_probe -- "$file" 1000 >"$work/probe.json"
  "$tandem" eval --policy "$file" --episodes 200 --record-dir "$work/$name" >/dev/null
  "$work/venv/bin/python" scripts/check_onnx.py "$file" "$work/actor.onnx" "$work/critic.onnx" "$work/probe.json" "$work/$name"
  "$tandem" policy import "$work/actor.onnx" --critic "$work/critic.onnx" --out "$work/back.safetensors" >/dev/null
  digest() { "$tandem" policy show "$1" --json | python3 -c 'import json, sys; print(json.load(sys.stdin)["digest"])'; }
  # Assigned first, because a command that fails inside of a comparison does not end the script.
  exported=$(digest "$file")
  imported=$(digest "$work/back.safetensors")
  [ "$exported" = "$imported" ] || { echo "$name changed by export and import"; exit 1; }
done
for log in "$work"/run/mcap/*.mcap; do "$tandem" replay "$log" --verify >/dev/null; done

echo '- policies push and carry a bar in another physics engine'
"$work/venv/bin/pip" install --quiet --requirement scripts/requirements-mujoco.txt
"$work/venv/bin/python" scripts/mujoco_transfer.py policies/teacher-push.safetensors \
  policies/teacher-push-classic.safetensors policies/student-carry-bar.safetensors --episodes 4 --json \
  --tandem "$tandem" \
  >"$work/transfer.json"
python3 - "$work/transfer.json" <<'PY'
import json, sys
results = json.load(open(sys.argv[1]))
assert len(results) == 3, results
for result, least in zip(results, [1.0, 1.0, 0.75]):
    assert result["rapier"]["success"] >= least and result["mujoco"]["success"] >= 0.75, result
PY

echo '- a client that knows nothing of it talks to a teacher'
head -c 32 /dev/urandom | base64 >"$work/token"
"$tandem" teacher --policy policies/teacher-push.safetensors --listen 127.0.0.1:0 --ledger "$work/ledger.sqlite" \
  --token-file "$work/token" >"$work/listening" 2>"$work/teacher.log" &
teacher=$!
trap 'kill "$teacher" 2>/dev/null || true; rm -rf "$work"' EXIT
for _ in $(seq 600); do grep -q listening "$work/listening" && break; sleep 0.1; done
address=$(sed -n 's/^listening on //p' "$work/listening")
ask() { "$work/venv/bin/python" scripts/teacher_client.py "$address" --token-file "$work/token" "$@"; }
ask --strategy mc-act:0.5 --budget 4 --steps 6 >"$work/asked"
grep -q '^4 of 6 steps charged, 0 units left' "$work/asked"
grep -q '^asked again: the same answers, 0 units left, 4 spent in all' "$work/asked"
expect 64 'expected none, ea' ask --account other --strategy mc-x
echo 'another-token-of-some-length' >"$work/other-token"
expect 64 'the token is wrong' ask --token-file "$work/other-token"
kill -TERM "$teacher"
wait "$teacher"
expect 75 'does not answer' ask

echo 'smoke run passed'
