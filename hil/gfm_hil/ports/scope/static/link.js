// The connection to the server: says hello, reconnects after a loss, passes on messages.

const KEY = "gfmhil-scope-token";

// The token comes after the # of the address, which browsers never send. The page removes it from
// the address bar, where others could read it, and keeps it for this tab.
function token() {
  const given = new URLSearchParams(location.hash.slice(1)).get("token");
  if (given) {
    sessionStorage.setItem(KEY, given);
    history.replaceState(null, "", location.pathname + location.search);
  }
  return sessionStorage.getItem(KEY) ?? "";
}

export class Link {
  // heard: {message(object), frame(ArrayBuffer), open(), lost()}
  constructor(heard) {
    this.heard = heard;
    this.token = token();
    this.waiting = new Map();
    this.next = 1;
    this.open();
  }

  open() {
    const scheme = location.protocol === "https:" ? "wss" : "ws";
    // The address names a network's converter. Pages with a token have places of their own: the query
    // announces that a hello comes first.
    const query = new URLSearchParams(location.search);
    if (this.token) query.set("control", "");
    this.socket = new WebSocket(`${scheme}://${location.host}/socket?${query}`);
    this.socket.binaryType = "arraybuffer";
    this.socket.onopen = () => {
      if (this.token) this.say({ kind: "hello", token: this.token });
      this.heard.open();
    };
    this.socket.onmessage = ({ data }) => {
      if (typeof data !== "string") this.heard.frame(data);
      else this.take(JSON.parse(data));
    };
    this.socket.onclose = () => {
      for (const done of this.waiting.values()) done({ ok: false, text: "the scope is gone" });
      this.waiting.clear();
      this.heard.lost();
      setTimeout(() => this.open(), 1000);
    };
  }

  take(message) {
    if (message.kind === "answer") {
      this.waiting.get(message.id)?.(message);
      this.waiting.delete(message.id);
    } else {
      this.heard.message(message);
    }
  }

  say(message) {
    if (this.socket.readyState === WebSocket.OPEN) this.socket.send(JSON.stringify(message));
  }

  // Sends an event; resolves to the run's answer: {ok, text} or {ok, tick, label}.
  tell(event) {
    const id = this.next++;
    return new Promise((done) => {
      if (this.socket.readyState !== WebSocket.OPEN) {
        done({ ok: false, text: "not connected" });
        return;
      }
      this.waiting.set(id, done);
      this.say({ kind: "command", id, event });
    });
  }
}
