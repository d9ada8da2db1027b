// SPDX-License-Identifier: Apache-2.0
// A PLC by node-opcua, which shares no code with the bridge's asyncua: a gap, a call, types, refusals.
//
//   NODE_PATH=.../node_modules node other_stack.cjs \
//     URL CERTIFICATE.pem KEY.pem USER PASSWORD CYCLE GAP_S
//
// What it has seen goes to standard output as one JSON object, in the last line.
"use strict";
const {
  AttributeIds, ClientMonitoredItem, DataType, MessageSecurityMode, OPCUAClient, SecurityPolicy,
  StatusCodes, TimestampsToReturn, UserTokenType, Variant,
} = require("node-opcua-client");

const [url, certificateFile, privateKeyFile, userName, password, cycle, gap] =
  process.argv.slice(2);
const SAMPLED_MS = 20, PROGRAM_MS = 50, WITHIN_MS = 30000 + 1000 * gap;
const cell = (path) => `ns=2;s=Cell.${path}`;
const sleep = (ms) => new Promise((done) => setTimeout(done, ms));

async function main() {
  const client = OPCUAClient.create({
    applicationName: "other_stack", applicationUri: "urn:robocal_ros:client:line",
    certificateFile, privateKeyFile, endpointMustExist: false,
    securityMode: MessageSecurityMode.SignAndEncrypt,
    securityPolicy: SecurityPolicy.Basic256Sha256,
    connectionStrategy: { maxRetry: 3, initialDelay: 200, maxDelay: 1000 },
  });
  await client.connect(url);
  const session = await client.createSession({ type: UserTokenType.UserName, userName, password });
  const seen = { calledMs: [] };
  const read = async (path) => (await session.read({ nodeId: cell(path) })).value.value;
  const write = async (path, dataType, value) =>
    (await session.write({
      nodeId: cell(path), attributeId: AttributeIds.Value,
      value: { value: new Variant({ dataType, value }) },
    })).name;
  const call = async (name, inputArguments) => {
    const methodId = cell(`Methods.${name}`), begun = performance.now();
    const found = await session.call({ objectId: cell("Methods"), methodId, inputArguments });
    seen.calledMs.push(performance.now() - begun);
    return [found.statusCode.name, ...(found.outputArguments || []).map((one) => one.value)];
  };
  const until = async (what, holds) => {
    const end = Date.now() + WITHIN_MS;
    for (;;) {
      const found = await holds();
      if (found) return found;
      if (Date.now() > end) throw new Error(`waited for ${what}`);
      await sleep(PROGRAM_MS);
    }
  };
  const browsed = await session.browse(cell("Accuracy").replace(".Accuracy", ""));
  seen.objects = browsed.references.map((one) => one.browseName.name);
  const kind = await session.read({
    nodeId: cell("LastCycle.Code"), attributeId: AttributeIds.DataType,
  });
  const definition = await session.read({
    nodeId: kind.value.value, attributeId: AttributeIds.DataTypeDefinition,
  });
  seen.codes = definition.value.value.fields.map((one) => one.name);
  seen.wrongType = await write("Gap.Heartbeat", DataType.Double, 1);
  seen.readOnly = await write("Gap.Beat", DataType.UInt32, 1);
  const decided = [
    { dataType: DataType.UInt32, value: 1 }, { dataType: DataType.String, value: "no" },
  ];
  seen.accept = (await call("Accept", decided))[0];
  seen.missing = (await call("Run", []))[0];

  // The program: the newest beat, which a subscription brings, is written in each of its cycles.
  let beat = 0, runs = true;
  const subscription = await session.createSubscription2({
    requestedPublishingInterval: SAMPLED_MS, requestedLifetimeCount: 1000,
    requestedMaxKeepAliveCount: 10, publishingEnabled: true, maxNotificationsPerPublish: 0,
  });
  const item = ClientMonitoredItem.create(
    subscription, { nodeId: cell("Gap.Beat"), attributeId: AttributeIds.Value },
    { samplingInterval: SAMPLED_MS, queueSize: 1, discardOldest: true }, TimestampsToReturn.Both,
  );
  item.on("changed", (value) => { beat = value.value.value; });
  const program = (async () => {
    while (runs) {
      seen.heartbeat = await write("Gap.Heartbeat", DataType.UInt32, beat);
      await sleep(PROGRAM_MS);
    }
    await write("Gap.Heartbeat", DataType.UInt32, 0);
  })();
  await until("an open gap", async () => beat && (await read("Maintenance.Doing")) === "");
  const arguments_ = [
    { dataType: DataType.String, value: cycle }, { dataType: DataType.Double, value: Number(gap) },
  ];
  seen.run = await until("a cycle that begins", async () => {
    const answer = await call("Run", arguments_);
    return answer[0] === StatusCodes.Good.name && answer[1] ? answer : null;
  });
  await until("its end", async () =>
    (await read("LastCycle.CycleId")) === cycle && (await read("LastCycle.Code")) !== 0);
  seen.status = await call("Status", [arguments_[0]]);
  seen.lastCode = await read("LastCycle.Code");
  runs = false;
  await program;
  await subscription.terminate();
  await session.close();
  await client.disconnect();
  process.stdout.write(`\n${JSON.stringify(seen)}`);
}

main().then(() => process.exit(0), (error) => { console.error(error); process.exit(1); });
