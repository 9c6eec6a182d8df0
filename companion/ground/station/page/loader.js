// A worker that fetches a log and passes it on in pieces, so that the page stays responsive.

const PIECE = 300;

self.addEventListener("message", async (event) => {
  try {
    const response = await fetch(event.data.url);
    if (!response.ok) throw new Error(`the monitor answers ${response.status}`);
    const { streams, ...head } = await response.json();
    self.postMessage({ kind: "head", head, count: streams.length });
    for (let k = 0; k < streams.length; k += PIECE) self.postMessage({ kind: "streams", streams: streams.slice(k, k + PIECE) });
    self.postMessage({ kind: "end" });
  } catch (error) {
    self.postMessage({ kind: "failed", text: String(error.message ?? error) });
  }
});
