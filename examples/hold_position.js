// Example joint controller over Modbus TCP with modbus-serial: holds the arm and moves it between two poses.
//
//     npm install --omit=optional
//     node hold_position.js 127.0.0.1 5020 16
//
// Each cycle reads four positions, computes four torques, writes them in one request, and waits for the next cycle.
// The exit code is 0 if the arm is at its goal at the end.
"use strict";

const ModbusRTU = require("modbus-serial");

const PERIOD = 0.02; // period of the control cycle, s
const MOVE_EVERY = 4.0; // s in each pose
const POSES = [
  [30, -45, 50, 20],
  [-20, 60, 120, -30],
]; // degrees, degrees, mm, degrees

// Gains: N·m per degree (N per mm) of error, and N·m per degree/s (N per mm/s) of speed.
const KP = [0.25, 0.25, 0.03, 0.004];
const KD = [0.04, 0.03, 0.002, 0.0005];
// Joint 3 carries the quill and counts positive downwards: an upward force compensates the weight.
const GRAVITY = [0, 0, -0.5 * 9.81, 0];
// Limits of the error, so that the arm does not accelerate too much toward a distant goal.
const MAX_ERROR = [30, 30, 40, 60];

const signed = (word) => (word > 32767 ? word - 65536 : word);
const limit = (value, bound) => Math.max(-bound, Math.min(bound, value));
const seconds = () => Number(process.hrtime.bigint()) * 1e-9;
const sleep = (time) => new Promise((resolve) => setTimeout(resolve, Math.max(0, time * 1000)));

async function main(host = "127.0.0.1", port = "5020", duration = "16") {
  const rig = new ModbusRTU();
  await rig.connectTCP(host, { port: Number(port) });
  rig.setID(1);
  rig.setTimeout(1000);

  const begin = seconds();
  let due = begin;
  let before = null;
  let speed = [0, 0, 0, 0];
  let error = [0, 0, 0, 0];
  for (;;) {
    const time = seconds() - begin;
    if (time >= Number(duration)) break;

    const answer = await rig.readHoldingRegisters(4, 4); // registers 5-8
    const position = answer.data.map((word) => signed(word) / 100);
    // The registers have a resolution of 0.01, so the difference quotient is filtered.
    if (before) speed = speed.map((s, j) => 0.5 * s + (0.5 * (position[j] - before[j])) / PERIOD);
    before = position;

    const goal = POSES[Math.trunc(time / MOVE_EVERY) % POSES.length];
    error = goal.map((g, j) => g - position[j]);
    const torque = error.map((e, j) => KP[j] * limit(e, MAX_ERROR[j]) - KD[j] * speed[j] + GRAVITY[j]);
    await rig.writeRegisters(0, torque.map((t) => Math.round(limit(1000 * t, 32767)) & 0xffff)); // registers 1-4

    due += PERIOD;
    await sleep(due - seconds());
  }
  await rig.writeRegisters(0, [0, 0, 0, 0]);
  await new Promise((resolve) => rig.close(resolve));
  console.log("error at the end:", error.map((e) => e.toFixed(2)).join(" "));
  return Math.max(...error.map(Math.abs)) < 2 ? 0 : 1;
}

main(...process.argv.slice(2)).then(
  (code) => process.exit(code),
  (error) => {
    console.error(`communication with the rig failed: ${error.message}`);
    process.exit(3);
  },
);
