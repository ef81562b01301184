//! Mailboxes of the browsers, which the render thread serves in turn.
//!
//! A mailbox keeps the latest request of each type, so that its memory is bounded and a slow device skips cameras instead
//! of lagging behind. A client has at most [`MAX_IN_FLIGHT`] frames that it has not acknowledged.

use std::collections::BTreeMap;
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};

use tokio::sync::mpsc;

use crate::protocol::request::{CompareRequest, OpenRequest, Request, ViewRequest};

/// Frames that a client may have without acknowledging one.
pub const MAX_IN_FLIGHT: usize = 2;
pub const MAX_CLIENTS: usize = 16;
/// Messages to a client that its socket has not taken.
const MAX_QUEUED: usize = 4;

pub type ClientId = u64;

#[derive(Debug, PartialEq)]
pub enum Job {
    Open(OpenRequest),
    View(ViewRequest),
    Compare(CompareRequest),
    /// The client is gone.
    Forget,
}

#[derive(Debug, Default)]
pub struct Clients {
    state: Mutex<State>,
    changed: Condvar,
}

#[derive(Debug, Default)]
struct State {
    clients: BTreeMap<ClientId, Client>,
    /// Clients whose memory in the render thread is to be freed.
    gone: Vec<ClientId>,
    next_id: ClientId,
    /// Client that was served last.
    served: ClientId,
    is_closed: bool,
}

#[derive(Debug)]
struct Client {
    sender: mpsc::Sender<Vec<u8>>,
    open: Option<OpenRequest>,
    view: Option<ViewRequest>,
    compare: Option<CompareRequest>,
    /// Sequence numbers of the frames that were sent and not acknowledged.
    in_flight: Vec<u64>,
}

impl Client {
    fn can_view(&self) -> bool {
        self.view.is_some() && self.in_flight.len() < MAX_IN_FLIGHT
    }

    fn is_ready(&self) -> bool {
        self.sender.capacity() > 0 && (self.open.is_some() || self.can_view() || self.compare.is_some())
    }

    fn take_job(&mut self) -> Option<Job> {
        if let Some(open) = self.open.take() {
            return Some(Job::Open(open));
        }
        if self.can_view()
            && let Some(view) = self.view.take()
        {
            return Some(Job::View(view));
        }
        self.compare.take().map(Job::Compare)
    }
}

impl State {
    /// Returns the ready client whose turn it is: the first one after the client that was served last.
    fn next_ready(&self) -> Option<ClientId> {
        let mut ready = self.clients.iter().filter(|(_, client)| client.is_ready()).map(|(id, _)| *id);
        let first = ready.next()?;
        Some(std::iter::once(first).chain(ready).find(|id| *id > self.served).unwrap_or(first))
    }
}

impl Clients {
    /// Adds a client and returns its messages; `None` for more than [`MAX_CLIENTS`].
    pub fn add(&self) -> Option<(ClientId, mpsc::Receiver<Vec<u8>>)> {
        let mut state = self.lock();
        if state.clients.len() >= MAX_CLIENTS {
            return None;
        }
        let (sender, receiver) = mpsc::channel(MAX_QUEUED);
        let id = state.next_id;
        state.next_id += 1;
        state.clients.insert(id, Client { sender, open: None, view: None, compare: None, in_flight: Vec::new() });
        Some((id, receiver))
    }

    /// Removes a client with all that it waits for.
    pub fn remove(&self, id: ClientId) {
        let mut state = self.lock();
        state.clients.remove(&id);
        state.gone.push(id);
        self.changed.notify_one();
    }

    /// Puts a request into the mailbox of its client, in place of an earlier one.
    pub fn post(&self, id: ClientId, request: Request) {
        let mut state = self.lock();
        let Some(client) = state.clients.get_mut(&id) else { return };
        match request {
            Request::Open(open) => {
                client.open = Some(open);
                // They belong to the scene before.
                (client.view, client.compare) = (None, None);
            }
            Request::View(view) => client.view = Some(view),
            Request::Compare(compare) => client.compare = Some(compare),
            Request::Ack { seq } => client.in_flight.retain(|frame| *frame != seq),
        }
        if client.is_ready() {
            self.changed.notify_one();
        }
    }

    /// Wakes the render thread after a socket took a message.
    pub fn socket_took_message(&self) {
        drop(self.lock());
        self.changed.notify_one();
    }

    /// Ends [`Clients::next_job`].
    pub fn close(&self) {
        self.lock().is_closed = true;
        self.changed.notify_one();
    }

    /// Waits for work; `None` after [`Clients::close`].
    pub fn next_job(&self) -> Option<(ClientId, Job)> {
        let mut state = self.lock();
        loop {
            if state.is_closed {
                return None;
            }
            if let Some(id) = state.gone.pop() {
                return Some((id, Job::Forget));
            }
            if let Some(id) = state.next_ready()
                && let Some(job) = state.clients.get_mut(&id).and_then(Client::take_job)
            {
                state.served = id;
                return Some((id, job));
            }
            state = self.changed.wait(state).unwrap_or_else(PoisonError::into_inner);
        }
    }

    /// Sends a result, unless the client is gone: of a frame with its sequence number, which waits for the acknowledgement.
    pub fn send(&self, id: ClientId, message: Vec<u8>, frame: Option<u64>) {
        if let Some(client) = self.lock().clients.get_mut(&id) {
            client.in_flight.extend(frame);
            // Jobs are taken only while the queue has room, and only the render thread fills it.
            drop(client.sender.try_send(message));
        }
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn view(seq: u64) -> Request {
        serde_json::from_str(&crate::protocol::request::tests::view(seq).to_string()).unwrap()
    }

    /// Takes the next job, which must be a view, and sends an empty frame.
    fn render(clients: &Clients) -> (ClientId, u64) {
        let (id, Job::View(request)) = clients.next_job().unwrap() else { panic!("a view") };
        clients.send(id, Vec::new(), Some(request.seq));
        (id, request.seq)
    }

    fn is_idle(clients: &Clients) -> bool {
        clients.lock().next_ready().is_none()
    }

    #[test]
    fn the_latest_camera_wins_and_two_frames_are_in_flight() {
        let clients = Clients::default();
        let (id, mut messages) = clients.add().unwrap();
        for seq in 0..5 {
            clients.post(id, view(seq));
        }
        assert_eq!(render(&clients), (id, 4));
        for seq in 5..9 {
            clients.post(id, view(seq));
        }
        assert_eq!(render(&clients), (id, 8));
        clients.post(id, view(9));
        assert!(is_idle(&clients), "two frames are in flight");
        clients.post(id, Request::Ack { seq: 77 });
        assert!(is_idle(&clients), "no such frame");
        clients.post(id, Request::Ack { seq: 4 });
        assert_eq!(render(&clients), (id, 9));
        assert!((0..3).all(|_| messages.try_recv().is_ok()) && messages.try_recv().is_err());
    }

    #[test]
    fn clients_are_served_in_turn() {
        let clients = Clients::default();
        let all: Vec<_> = (0..3).map(|_| clients.add().unwrap()).collect();
        let ids: Vec<_> = all.iter().map(|(id, _)| *id).collect();
        let frames = |count: usize, asking: &[ClientId]| -> Vec<ClientId> {
            let mut served = Vec::new();
            for seq in 0..count as u64 {
                // A client that always has another camera does not keep the others waiting.
                for id in asking {
                    clients.post(*id, view(seq));
                }
                let (id, frame) = render(&clients);
                clients.post(id, Request::Ack { seq: frame });
                served.push(id);
            }
            served
        };
        let [a, b, c] = [ids[0], ids[1], ids[2]];
        assert_eq!(frames(1, &[a]), [a]);
        // The queue of a client holds four messages, which nobody reads here.
        assert_eq!(frames(6, &ids), [b, c, a, b, c, a]);
        assert_eq!(frames(2, &[a, c]), [b, c], "the camera of b was waiting");
    }

    #[test]
    fn the_number_of_clients_and_of_their_messages_is_bounded() {
        let clients = Clients::default();
        let ids: Vec<_> = (0..MAX_CLIENTS).map(|_| clients.add().unwrap()).collect();
        assert!(clients.add().is_none());
        let id = ids[3].0;
        let open = OpenRequest { scene: 0, stored: None };
        for _ in 0..MAX_QUEUED {
            clients.post(id, Request::Open(open));
            assert_eq!(clients.next_job(), Some((id, Job::Open(open))));
            clients.send(id, Vec::new(), None);
        }
        clients.post(id, view(1));
        assert!(is_idle(&clients), "a client that reads nothing gets no more work");
        clients.remove(id);
        assert_eq!(clients.next_job(), Some((id, Job::Forget)));
        clients.post(id, view(2));
        clients.send(id, Vec::new(), None);
        assert!(is_idle(&clients) && clients.add().is_some());
        clients.close();
        assert_eq!(clients.next_job(), None);
    }
}
