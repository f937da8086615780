// The service worker: between the page and the network. It fetches nothing but the files that
// site.js names, lets none in with another hash, keeps all of them, and sends the page and its
// worker their content security policy with them, whatever host the site stands on.

importScripts("site.js");

const OWN = `multipos-${SITE.id}`;
const RUNTIME = `pyodide-${SITE.runtime.files["pyodide.asm.wasm"].slice(7, 23).replace(/\W/g, "")}`;
const HOME = new URL("./", location.href).href;
const BASE = new URL(SITE.runtime.base, HOME).href;
const TYPES = {
  html: "text/html; charset=utf-8", js: "text/javascript; charset=utf-8", mjs: "text/javascript",
  css: "text/css; charset=utf-8", json: "application/json", wasm: "application/wasm",
  svg: "image/svg+xml", webmanifest: "application/manifest+json",
};

/** Return where an address is kept and which hash its file has, or nothing of what is not ours. */
function known(address) {
  const url = new URL(address);
  url.search = url.hash = "";
  const runtime = url.href.startsWith(BASE) && SITE.runtime.files[url.href.slice(BASE.length)];
  if (runtime) return { store: RUNTIME, url: url.href, integrity: runtime };
  if (!url.href.startsWith(HOME)) return null;
  const name = url.href.slice(HOME.length) || "index.html";
  if (name === "site.js") return { store: OWN, url: HOME + name, integrity: "" };
  const integrity = SITE.files[name];
  return integrity ? { store: OWN, url: HOME + name, integrity } : null;
}

/** Return a file with its type and policy, kept from the first time on. */
async function fetched(file) {
  const store = await caches.open(file.store);
  const kept = await store.match(file.url);
  if (kept) return kept;
  let answer;
  try {
    answer = await fetch(file.url, { cache: "no-cache", credentials: "same-origin", mode: "cors" });
    if (!answer.ok) throw new Error(`${answer.status}`);
  } catch (error) {
    return refused(file.url, `cannot be fetched (${error.message})`);
  }
  const content = await answer.arrayBuffer();
  if (file.integrity && await digest(content) !== file.integrity) {
    return refused(file.url, "is not the file that belongs here: its hash differs");
  }
  const made = new Response(content, { headers: headers(file.url) });
  await store.put(file.url, made.clone());
  return made;
}

async function digest(content) {
  const bytes = new Uint8Array(await crypto.subtle.digest("SHA-256", content));
  return `sha256-${btoa(String.fromCharCode(...bytes))}`;
}

function headers(url) {
  const name = url.slice(url.lastIndexOf("/") + 1);
  const policy = name === "worker.js" || url.startsWith(BASE) ? "worker" : "page";
  return {
    "Content-Type": TYPES[name.slice(name.lastIndexOf(".") + 1)] || "application/octet-stream",
    "Content-Security-Policy": SITE.policies[policy],
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
  };
}

/** Tell the pages which file it is, for all that their worker learns is that something failed. */
async function refused(url, why) {
  const pages = await clients.matchAll({ includeUncontrolled: true, type: "window" });
  for (const page of pages) page.postMessage({ refused: `${url} ${why}.` });
  return new Response(`${url} ${why}.`, { status: 502 });
}

self.addEventListener("install", event => {
  const own = ["site.js", ...Object.keys(SITE.files)].map(name => fetched(known(HOME + name)));
  event.waitUntil(Promise.all(own));
});

self.addEventListener("activate", event => {
  event.waitUntil((async () => {
    const old = (await caches.keys()).filter(name => name !== OWN && name !== RUNTIME);
    await Promise.all(old.filter(name => /^(multipos|pyodide)-/.test(name)).map(name => caches.delete(name)));
    await clients.claim();
  })());
});

// A newer service worker waits until a page begins: none shall run with parts of two sites.
self.addEventListener("message", event => {
  if (event.data === "take over") self.skipWaiting();
});

self.addEventListener("fetch", event => {
  const file = event.request.method === "GET" && known(event.request.url);
  if (file) event.respondWith(fetched(file));
});
