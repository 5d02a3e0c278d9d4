// A worker that computes the digest of 1,000 steps of a policy in an instance of its own.

import { Simulator } from "./simulator.js";

onmessage = async ({ data: policy }) => {
  try {
    const simulator = await Simulator.load("tandem_demo.wasm.gz");
    simulator.read("load_policy", policy, 0);
    postMessage({ digest: simulator.json("digest").digest });
  } catch (error) {
    postMessage({ problem: error.message });
  }
};
