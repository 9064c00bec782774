// Hold the arm, and move it: a joint controller over Modbus TCP with modbus-serial. A place to start from.
//
//     npm install --omit=optional
//     node hold_position.js 127.0.0.1 5020 16
//
// Each turn of the loop reads four positions, computes four torques and writes them at once, then waits for the next
// turn. Ends with exit code 0 if the arm is where it was sent.
"use strict";

const ModbusRTU = require("modbus-serial");

const PERIOD = 0.02; // s between two turns of the loop
const MOVE_EVERY = 4.0; // s in each pose
const POSES = [
  [30, -45, 50, 20],
  [-20, 60, 120, -30],
]; // degrees, degrees, mm, degrees

// What one degree (mm) of error, and one degree (mm) a second of speed, is worth; N·m and N.
const KP = [0.25, 0.25, 0.03, 0.004];
const KD = [0.04, 0.03, 0.002, 0.0005];
// The quill hangs on joint 3, which counts positive downwards: its weight is carried with a force upwards.
const GRAVITY = [0, 0, -0.5 * 9.81, 0];
// Errors that count no further: the arm does not leap at a far goal.
const MOST = [30, 30, 40, 60];

const signed = (word) => (word > 32767 ? word - 65536 : word);
const limit = (value, most) => Math.max(-most, Math.min(most, value));
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
    // The registers step by 0.01: the difference of two is rough, so it is smoothed.
    if (before) speed = speed.map((s, j) => 0.5 * s + (0.5 * (position[j] - before[j])) / PERIOD);
    before = position;

    const goal = POSES[Math.floor(time / MOVE_EVERY) % POSES.length];
    error = goal.map((g, j) => g - position[j]);
    const torque = error.map((e, j) => KP[j] * limit(e, MOST[j]) - KD[j] * speed[j] + GRAVITY[j]);
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
    console.error(`the rig does not answer as it should: ${error.message}`);
    process.exit(3);
  },
);
