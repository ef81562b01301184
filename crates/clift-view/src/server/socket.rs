//! One WebSocket: requests into the mailbox, messages out.

use std::sync::Arc;
use std::time::Duration;

use axum::body::Bytes;
use axum::extract::ws::{CloseFrame, Message, WebSocket};

use crate::protocol::request::Request;
use crate::session::clients::Clients;

/// Longest time for one message to leave.
const SEND_TIMEOUT: Duration = Duration::from_secs(10);
/// Close codes of RFC 6455: invalid payload, try again later.
const INVALID: u16 = 1007;
const FULL: u16 = 1013;

/// Serves a socket until it closes, sends an invalid message or takes no message for ten seconds.
pub async fn serve(mut socket: WebSocket, clients: Arc<Clients>, hello: Bytes) {
    let Some((id, mut messages)) = clients.add() else {
        close(&mut socket, FULL, "too many open tabs").await;
        return;
    };
    let mut next = Some(Message::Binary(hello));
    loop {
        if let Some(message) = next.take() {
            match tokio::time::timeout(SEND_TIMEOUT, socket.send(message)).await {
                Ok(Ok(())) => clients.socket_took_message(),
                _ => break,
            }
        }
        tokio::select! {
            received = socket.recv() => {
                let text = match received {
                    Some(Ok(Message::Text(text))) => text,
                    Some(Ok(Message::Ping(_) | Message::Pong(_))) => "".into(),
                    Some(Ok(Message::Binary(_))) => {
                        close(&mut socket, INVALID, "requests are text").await;
                        break;
                    }
                    Some(Ok(Message::Close(_)) | Err(_)) | None => break,
                };
                match serde_json::from_str::<Request>(&text) {
                    Ok(request) => clients.post(id, request),
                    Err(_) if text.is_empty() => {}
                    Err(_) => {
                        close(&mut socket, INVALID, "invalid request").await;
                        break;
                    }
                }
            }
            message = messages.recv() => match message {
                Some(bytes) => next = Some(Message::Binary(bytes.into())),
                None => break,
            },
        }
    }
    clients.remove(id);
}

async fn close(socket: &mut WebSocket, code: u16, reason: &'static str) {
    let frame = CloseFrame { code, reason: reason.into() };
    drop(tokio::time::timeout(SEND_TIMEOUT, socket.send(Message::Close(Some(frame)))).await);
}
