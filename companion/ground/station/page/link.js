// The WebSocket to the monitor: sends the token, reconnects by itself, and can be renewed when no data arrives.

const BACKOFF_MS = [200, 400, 800, 1500, 2000];
const TOKEN_KEY = "companion-token";

/** The token from the address (#token=...). It is kept for reloads of this tab and removed from the address line. */
export function takeToken() {
  const given = new URLSearchParams(location.hash.slice(1)).get("token");
  try {
    if (given) {
      sessionStorage.setItem(TOKEN_KEY, given);
      history.replaceState(null, "", location.pathname + location.search);
    }
    return given ?? sessionStorage.getItem(TOKEN_KEY);
  } catch {
    return given; // storage is disabled: the token is lost at the next reload
  }
}

export class Link {
  /**
   * @param token the token that the server printed, or null for view only
   * @param onMessage called with each parsed message
   * @param onChange called when the connection opens or closes
   */
  constructor(token, onMessage, onChange) {
    this.open = false;
    this.failures = 0;
    this._token = token;
    this._onMessage = onMessage;
    this._onChange = onChange;
    this._socket = null;
    this._timer = null;
    this._connect();
  }

  /** Send a message; return false if there is no connection. */
  send(message) {
    if (!this.open) return false;
    this._socket.send(JSON.stringify(message));
    return true;
  }

  /** Close the connection and open a new one at once. */
  renew() {
    this._ended(this._socket);
    clearTimeout(this._timer);
    this._connect();
  }

  _connect() {
    const scheme = location.protocol === "https:" ? "wss:" : "ws:";
    const socket = new WebSocket(`${scheme}//${location.host}/ws`);
    this._socket = socket;
    socket.addEventListener("open", () => {
      if (socket !== this._socket) return;
      this.open = true;
      this.failures = 0;
      socket.send(JSON.stringify({ kind: "token", token: this._token ?? "" }));
      this._onChange();
    });
    socket.addEventListener("message", (event) => {
      if (socket === this._socket) this._read(event.data);
    });
    socket.addEventListener("close", () => this._ended(socket));
  }

  _read(text) {
    let message;
    try {
      message = JSON.parse(text);
    } catch {
      return; // the server sends only JSON; ignore anything else
    }
    if (message && typeof message.kind === "string") this._onMessage(message);
  }

  _ended(socket) {
    if (socket !== this._socket) return;
    this._socket = null;
    this.open = false;
    socket.close();
    const wait = BACKOFF_MS[Math.min(this.failures, BACKOFF_MS.length - 1)];
    this.failures += 1;
    this._timer = setTimeout(() => this._connect(), wait);
    this._onChange();
  }
}
