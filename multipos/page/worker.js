// The worker: Pyodide, NumPy and the package, away from the page so that it stays alive.

import "./site.js";

const BASE = new URL(SITE.runtime.base, location.href).href;
const IMPORTS = "from multipos.page.visit import Visit\nvisit = Visit()\nvisit.answer";

async function start() {
  const { loadPyodide } = await import(`${BASE}pyodide.mjs`);
  const lockFileURL = new URL("pyodide-lock.json", location.href).href;
  const pyodide = await loadPyodide({ indexURL: BASE, lockFileURL, fullStdLib: false });
  const packages = [BASE + SITE.runtime.numpy, new URL(SITE.wheel, location.href).href];
  await pyodide.loadPackage(packages, { messageCallback: () => {} });
  return { files: pyodide.FS, answer: pyodide.runPython(IMPORTS) };
}

const started = start();
started.then(() => postMessage({ ready: true }), error => postMessage({ fatal: String(error) }));

/** Put files where the program finds them, ask it, and bring back what it has written. */
async function serve({ id, request, files }) {
  const program = await started;
  const names = files.map(({ name }) => name);
  for (const { name, content } of files) program.files.writeFile(name, new Uint8Array(content));
  let answer;
  try {
    answer = JSON.parse(program.answer(JSON.stringify(request)));
  } finally {
    for (const name of names) program.files.unlink(name);
  }
  const transfer = [];
  if (answer.path) {
    answer.content = program.files.readFile(answer.path);
    transfer.push(answer.content.buffer);
    program.files.unlink(answer.path);
  }
  postMessage({ id, answer }, transfer);
}

let last = Promise.resolve();
addEventListener("message", ({ data }) => {
  // One after the other; what breaks the program itself ends it, and the page starts it anew.
  last = last.then(() => serve(data)).catch(error => postMessage({ fatal: String(error) }));
});
