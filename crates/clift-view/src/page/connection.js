// The WebSocket: requests as JSON, replies as a JSON header with binary parts.

const FIRST_RETRY_MS = 500;
const LAST_RETRY_MS = 8000;

/** Splits a reply: the length of the header (u32, little-endian), the header, its parts. */
export function parseReply(buffer) {
  const length = new DataView(buffer).getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  let at = 4 + length;
  const parts = header.parts.map((size) => {
    const part = new Uint8Array(buffer, at, size);
    at += size;
    return part;
  });
  return { header, parts };
}

export class Connection {
  /** `onReply(header, parts)` receives replies, `onState(text)` a problem, or null once connected. */
  constructor(onReply, onState) {
    this.onReply = onReply;
    this.onState = onState;
    this.retryMs = FIRST_RETRY_MS;
    this.open();
  }

  open() {
    const socket = new WebSocket(`ws://${location.host}/socket`);
    socket.binaryType = "arraybuffer";
    this.socket = socket;
    socket.onopen = () => {
      this.retryMs = FIRST_RETRY_MS;
      this.onState(null);
    };
    socket.onmessage = ({ data }) => {
      const { header, parts } = parseReply(data);
      this.onReply(header, parts);
    };
    socket.onclose = ({ reason }) => {
      this.onState(reason ? `The server closed the connection: ${reason}.` : "No connection to clift view. After a restart, open the URL that it printed. Trying again …");
      setTimeout(() => this.open(), this.retryMs);
      this.retryMs = Math.min(2 * this.retryMs, LAST_RETRY_MS);
    };
  }

  get isOpen() {
    return this.socket.readyState === WebSocket.OPEN;
  }

  send(message) {
    if (this.isOpen) this.socket.send(JSON.stringify(message));
  }
}
