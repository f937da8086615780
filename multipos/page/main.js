// The page: takes files and rows, asks the worker, shows what it answers. Nothing is computed here.

import "./site.js";
import { $, cell, decimals, element, legend, makeSphere, parameterRow, shade } from "./drawing.js";

const LARGEST = 100e6; // bytes of a file: a browser keeps several copies of it
const EXAMPLE = `position,direction,ax,ay,az
1,E-U-S,0.0071,1.0029,-0.0016
2,E-N-U,-0.0094,-0.0058,1.0008
3,D-E-S,-0.9965,0.0064,0.0015
4,W-D-S,-0.0076,-1.0030,0.0032
5,U-W-S,0.9965,0.0073,0.0027
6,S-W-D,0.0067,-0.0060,-1.0008
`;

// State -----------------------------------------------------------------------------------------

const STATUS = { loading: "The program is being loaded, 10 MB the first time…", working: "Calculating…" };
const OF_OPTIONS = "What --unit and --outputs say is chosen above; other options are those of the command line.";

function become(state) {
  document.documentElement.dataset.state = state;
  const named = state === "error" && $("error").textContent.includes("--");
  $("status").textContent = named ? OF_OPTIONS : STATUS[state] || "";
}

function fail(text) {
  $("error").textContent = text;
  $("error").hidden = !text;
  if (!text) return;
  become("error");
  $("error").scrollIntoView({ block: "nearest" });
}

// The worker ------------------------------------------------------------------------------------

let worker = null, count = 0;
const waiting = new Map();

/** Have the service worker between us and the network, for it brings every file and its policy. */
async function guard() {
  if (!navigator.serviceWorker) {
    throw new Error("This browser gives the page no service worker here: open it by https or on localhost, and not in a private window.");
  }
  navigator.serviceWorker.addEventListener("message", ({ data }) => data.refused && fail(data.refused));
  const changed = new Promise(resolve => {
    navigator.serviceWorker.addEventListener("controllerchange", resolve, { once: true });
  });
  const found = await navigator.serviceWorker.register("sw.js", { updateViaCache: "none" });
  await navigator.serviceWorker.ready;
  if (!navigator.serviceWorker.controller) await changed;
  else if (found.waiting) { // a newer site, found by the last visit: this page begins anew as that
    found.waiting.postMessage("take over");
    await changed;
    location.reload();
    await new Promise(() => {});
  }
}

function startWorker() {
  worker = new Worker("worker.js", { type: "module" });
  worker.onmessage = ({ data }) => {
    if (data.ready && document.documentElement.dataset.state === "loading") become("ready");
    if (data.fatal) broken(data.fatal);
    waiting.get(data.id)?.(data.answer);
    waiting.delete(data.id);
  };
  worker.onerror = event => broken(event.message || "the worker could not be loaded");
}

/** The program itself has ended, as it does where memory ends: say so, and start it anew. */
function broken(why) {
  worker.terminate();
  const open = [...waiting.values()];
  waiting.clear();
  for (const each of open) each({ error: `The program has ended: ${why}. Give fewer rows, or use the command line.` });
  if (open.length) startWorker();
  else if ($("error").hidden) fail(`The program cannot be loaded: ${why}`);
}

const started = guard().then(startWorker, error => { fail(error.message); throw error; });
started.catch(() => {});

/** Return the program's answer to a request, with files {name, content}. */
async function ask(request, files = []) {
  await started;
  const id = ++count;
  const answer = new Promise(resolve => waiting.set(id, resolve));
  worker.postMessage({ id, request, files }, files.map(each => each.content));
  return answer;
}

/** Return files as the program takes them; what is too large is refused in words. */
async function contents(files) {
  const large = [...files].find(each => each.size > LARGEST);
  if (large) {
    throw new Error(`${large.name} has ${Math.round(large.size / 1e6)} MB, and this page takes ${LARGEST / 1e6} MB: use multipos calibrate on your machine.`);
  }
  return Promise.all([...files].map(async each => ({ name: each.name, content: await each.arrayBuffer() })));
}

// Calibrate -------------------------------------------------------------------------------------

const KINDS = { known: "known orientations", six: "six faces", free: "hand-held", log: "raw log" };
const LEVELS = { error: "Not fit for use", warning: "Warning", note: "Note" };
const sphere = makeSphere($("positions"));
let chosen = []; // the files of now; none where the rows count
let rowsThen = ""; // what stood there when they were chosen
let runs = 0;

/** Ask, and give the answer to `then`, or nothing where it failed; only the newest run counts. */
async function run(request, files, then) {
  const mine = ++runs;
  fail("");
  become("working");
  let answer;
  try {
    const given = await contents(files);
    answer = await ask({ ...request, files: given.map(each => each.name) }, given);
  } catch (error) {
    answer = { error: error.message };
  }
  if (mine !== runs) return;
  then(answer.error ? null : answer);
  if (answer.error) fail(answer.error);
  else become("done");
}

function calibrate() {
  if ($("rows").value !== rowsThen) chosen = [];
  if (!chosen.length && !$("rows").value.trim()) {
    fail("There are no rows: drop a file, paste rows, or press Example.");
    return;
  }
  const rows = new Blob([$("rows").value]);
  rows.name = "calibration.csv";
  const request = { do: "calibrate", kind: $("kind").value, unit: $("unit").value, outputs: $("outputs").value };
  run(request, chosen.length ? chosen : [rows], answer => {
    $("result").hidden = !answer;
    if (!answer) return;
    show(answer);
    $("answer").focus();
    $("answer").scrollIntoView({ block: "nearest" });
    const mine = runs;
    setTimeout(() => mine === runs && showRefused(), 200); // one more fit shall not wait for it
  });
}

function show(answer) {
  $("answer").textContent = answer.sentence;
  for (const name of ["kind", "unit"]) {
    $(name).options[0].textContent = `what they show: ${KINDS[answer[name]] || answer[name]}`;
  }
  const items = answer.findings.map(finding => {
    const stop = !finding.action || /[.?!]$/.test(finding.text) ? " " : ". ";
    const said = `${LEVELS[finding.level]}: ${finding.text}${stop}`;
    const made = element("li", [said, element("b", finding.action)], finding.level);
    made.dataset.code = finding.code;
    return made;
  });
  if (answer.findings.every(finding => finding.level === "note")) {
    items.unshift(element("li", "There is nothing to warn of."));
  }
  if (answer.findings.some(finding => finding.action.includes("--"))) {
    items.push(element("li", "Options (--…) are those of the command line: download the readings and give both to multipos fit.", "soft"));
  }
  $("findings").replaceChildren(...items);
  $("parameters").tBodies[0].replaceChildren(...answer.parameters.map(each => {
    const digits = decimals(each.U), numbers = [each.value, each.U];
    return parameterRow(each, [...numbers.map(x => cell(x.toFixed(digits), true)), cell(each.unit)]);
  }));
  const marks = answer.positions.map(each => ({
    direction: each.direction, label: each.position, kind: shade(each.residual, each.residual_u),
    title: `${each.position}: ${each.residual_text}`,
  }));
  const next = answer.next.map((each, i) => ({ direction: each.direction, kind: "next", label: `${i + 1}`, title: each.words }));
  sphere.show([...marks, ...next]);
  $("positions-title").textContent = answer.positions_title;
  $("positions").setAttribute("aria-label", `${marks.length} positions on a sphere; arrow keys turn it`);
  $("next").replaceChildren(...answer.next.map(each => element("li",
    `${each.words}: u falls by ${(100 * each.fall).toFixed(1)} %`)));
}

/** Show the cost of every target that is refused, and a button that accepts it. */
async function showRefused() {
  $("refused").replaceChildren();
  const answer = await ask({ do: "targets" });
  $("refused").replaceChildren(...Object.entries(answer.refused || {}).map(([form, why]) => {
    const accept = element("button", `Accept and download ${form}`);
    accept.type = "button";
    accept.dataset.accept = form;
    accept.onclick = () => download(form, true);
    return element("li", [element("p", why), accept]);
  }));
}

function save(name, content) {
  const link = element("a");
  link.href = URL.createObjectURL(new Blob([content]));
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10000);
}

const kept = {}; // files that were made already: the scheme, the compensated rows

async function download(form, accept = false) {
  fail("");
  const answer = kept[form] || await ask({ do: "download", form, accept });
  if (answer.error) fail(answer.error);
  else save(answer.name, answer.content);
}

// Plan and apply --------------------------------------------------------------------------------

const planned = makeSphere($("plan-positions"));

function plan() {
  const [model, positions] = [$("plan-model").value, Number($("plan-count").value)];
  run({ do: "plan", model, positions, hand_held: $("plan-free").checked }, [], showPlan);
}

function showPlan(answer) {
  $("sheet").hidden = !answer;
  if (!answer) return;
  kept.scheme = answer;
  $("plan-answer").textContent = answer.sentence;
  planned.show(answer.positions.map(each => ({ direction: each.direction, kind: "now", label: each.position, title: each.words })));
  $("plan-positions").setAttribute("aria-label", answer.sentence);
  const box = () => element("td", "", "box");
  $("plan-table").tBodies[0].replaceChildren(...answer.positions.map(each =>
    element("tr", [cell(each.position), cell(each.words), box(), box(), box()])));
}

function print() {
  document.body.classList.add("sheet");
  window.print();
  document.body.classList.remove("sheet");
}

function apply() {
  const [log, calibration] = [$("apply-log").files, $("apply-calibration").files];
  if (!log.length) {
    fail("There is no log: choose a file.");
    return;
  }
  const request = { do: "apply", calibration: calibration[0]?.name || "", tilt: $("apply-tilt").checked };
  run(request, [log[0], ...calibration], answer => {
    $("apply-answer").textContent = answer ? answer.sentence : "";
    document.querySelector("[data-download=applied]").hidden = !answer;
    if (answer) kept.applied = answer;
  });
}

// Wiring ----------------------------------------------------------------------------------------

function take(files) {
  if (!files.length) return;
  chosen = [...files];
  rowsThen = $("rows").value;
  calibrate();
}

$("file").onchange = () => take($("file").files);
$("rows").oninput = () => { chosen = []; $("file").value = ""; };
$("example").onclick = () => {
  $("rows").value = EXAMPLE;
  $("rows").oninput();
  calibrate();
};
$("calibrate").onclick = calibrate;
$("plan-make").onclick = plan;
$("plan-print").onclick = print;
$("apply-make").onclick = apply;
for (const each of document.querySelectorAll("[data-download]")) each.onclick = () => download(each.dataset.download);
addEventListener("dragover", event => { event.preventDefault(); document.body.classList.add("dropping"); });
addEventListener("dragleave", () => document.body.classList.remove("dropping"));
addEventListener("drop", event => {
  event.preventDefault();
  document.body.classList.remove("dropping");
  take(event.dataTransfer.files);
});
function openView() {
  const view = location.hash && document.querySelector(`details${location.hash}`);
  if (view) view.open = true;
}
addEventListener("hashchange", openView);
openView();
const host = $("host").dataset.host;
$("host").textContent = host
  ? `The first visit fetches the Python runtime from ${host}, which sees that visit; later ones need no network.`
  : "After the first visit this page needs no network.";
$("legend").replaceChildren(...legend([
  ["good", "residual within its U"], ["warn", "beyond U"], ["bad", "beyond 2 U"], ["next", "best next"],
]));
become(document.documentElement.dataset.state);
