//! Mailboxes of the browsers, and whose turn it is.
//!
//! A mailbox keeps the latest request of each type, so that its memory is bounded and a slow device skips cameras instead
//! of lagging behind. A client has at most [`MAX_IN_FLIGHT`] frames that it has not acknowledged. The client with the least
//! device time is served first; one that was idle starts at the time of the last served, so that it saves none up.

use std::collections::BTreeMap;
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Instant;

use tokio::sync::mpsc;

use crate::protocol::request::{CompareRequest, OpenRequest, Request, ViewRequest};
use crate::session::frame_budget::FrameBudget;

/// Frames that a client may have without acknowledging one.
pub const MAX_IN_FLIGHT: usize = 2;
/// Most clients at a time.
pub const MAX_CLIENTS: usize = 16;
/// Messages to a client that its socket has not taken.
const MAX_QUEUED: usize = 4;

pub type ClientId = u64;

/// Work for the render thread.
#[derive(Debug, PartialEq)]
pub enum Job {
    Open(OpenRequest),
    View(ViewRequest, FrameBudget),
    Compare(CompareRequest),
    /// The client is gone.
    Forget,
}

/// All connected browsers.
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
    /// Device time of the client that was served last, at its turn.
    clock_s: f64,
    is_closed: bool,
}

#[derive(Debug)]
struct Client {
    sender: mpsc::Sender<Vec<u8>>,
    open: Option<OpenRequest>,
    view: Option<ViewRequest>,
    compare: Option<CompareRequest>,
    in_flight: Vec<InFlight>,
    budget: FrameBudget,
    /// Device time in seconds.
    used_s: f64,
}

/// A frame that was sent and not acknowledged.
#[derive(Clone, Copy, Debug)]
struct InFlight {
    seq: u64,
    sent: Instant,
    /// Seconds from the request's turn to the picture's bytes.
    render_s: f64,
    /// Budget in seconds and wanted size, while the camera moves.
    budget: Option<(f64, usize)>,
}

/// A finished frame, for the budget of its client.
#[derive(Clone, Copy, Debug)]
pub struct SentFrame {
    pub seq: u64,
    pub budget: Option<(f64, usize)>,
}

impl Client {
    fn has_room(&self) -> bool {
        self.sender.capacity() > 0
    }

    fn is_ready(&self) -> bool {
        let has_view = self.view.is_some() && self.in_flight.len() < MAX_IN_FLIGHT;
        self.has_room() && (self.open.is_some() || has_view || self.compare.is_some())
    }

    fn take_job(&mut self) -> Option<Job> {
        if let Some(open) = self.open.take() {
            return Some(Job::Open(open));
        }
        if self.in_flight.len() < MAX_IN_FLIGHT
            && let Some(view) = self.view.take()
        {
            return Some(Job::View(view, self.budget));
        }
        self.compare.take().map(Job::Compare)
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
        let client = Client {
            sender,
            open: None,
            view: None,
            compare: None,
            in_flight: Vec::new(),
            budget: FrameBudget::default(),
            used_s: 0.0,
        };
        state.clients.insert(id, client);
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
        let clock_s = state.clock_s;
        let Some(client) = state.clients.get_mut(&id) else { return };
        if !client.is_ready() {
            client.used_s = client.used_s.max(clock_s);
        }
        match request {
            Request::Open(open) => {
                client.open = Some(open);
                // They belong to the scene before.
                (client.view, client.compare) = (None, None);
            }
            Request::View(view) => client.view = Some(view),
            Request::Compare(compare) => client.compare = Some(compare),
            Request::Ack { seq } => client.acknowledge(seq),
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
            let ready = state.clients.iter_mut().filter(|(_, client)| client.is_ready());
            let next = ready.min_by(|(_, a), (_, b)| a.used_s.total_cmp(&b.used_s));
            let taken = next.and_then(|(&id, client)| Some((id, client.used_s, client.take_job()?)));
            if let Some((id, used_s, job)) = taken {
                state.clock_s = state.clock_s.max(used_s);
                return Some((id, job));
            }
            state = self.changed.wait(state).unwrap_or_else(PoisonError::into_inner);
        }
    }

    /// Sends the result of a job that took `seconds` of the device.
    pub fn finish(&self, id: ClientId, seconds: f64, message: Vec<u8>, frame: Option<SentFrame>) {
        let mut state = self.lock();
        let is_alone = !state.clients.iter().any(|(other, client)| *other != id && client.is_ready());
        let clock_s = state.clock_s;
        let Some(client) = state.clients.get_mut(&id) else { return };
        client.used_s += seconds;
        let used_s = client.used_s;
        if let Some(SentFrame { seq, budget }) = frame {
            client.in_flight.push(InFlight { seq, sent: Instant::now(), render_s: seconds, budget });
        }
        // Jobs are taken only while the queue has room, and only this thread fills it.
        drop(client.sender.try_send(message));
        if is_alone {
            // Nobody waited: the time is not held against the client later.
            state.clock_s = clock_s.max(used_s);
        }
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Client {
    fn acknowledge(&mut self, seq: u64) {
        let Some(position) = self.in_flight.iter().position(|frame| frame.seq == seq) else { return };
        let InFlight { sent, render_s, budget, .. } = self.in_flight.remove(position);
        // Rendering and transfer overlap, so that the slower of the two limits the rate.
        let seconds = render_s.max(sent.elapsed().as_secs_f64());
        if let Some((budget_s, size)) = budget {
            self.budget.record(seconds, budget_s, size);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn view(seq: u64) -> Request {
        let text = format!(
            r#"{{"type": "view", "seq": {seq}, "c2w": [1,0,0,0,0,1,0,0,0,0,1,0], "intrinsics": [1,1,0.5,0.5],
                "tokens": 4, "selection": "paper", "precision": "f32", "size": 0, "budget_ms": null, "rest": false,
                "list_tokens": false}}"#
        );
        serde_json::from_str(&text).unwrap()
    }

    /// Takes the next job, which must be a view, and finishes it after `seconds`.
    fn render(clients: &Clients, seconds: f64) -> (ClientId, u64) {
        let (id, Job::View(request, _)) = clients.next_job().unwrap() else { panic!("a view") };
        clients.finish(id, seconds, Vec::new(), Some(SentFrame { seq: request.seq, budget: None }));
        (id, request.seq)
    }

    fn is_idle(clients: &Clients) -> bool {
        !clients.lock().clients.values().any(Client::is_ready)
    }

    #[test]
    fn the_latest_camera_wins_and_two_frames_are_in_flight() {
        let clients = Clients::default();
        let (id, mut messages) = clients.add().unwrap();
        for seq in 0..5 {
            clients.post(id, view(seq));
        }
        assert_eq!(render(&clients, 0.01), (id, 4));
        for seq in 5..9 {
            clients.post(id, view(seq));
        }
        assert_eq!(render(&clients, 0.01), (id, 8));
        clients.post(id, view(9));
        assert!(is_idle(&clients), "two frames are in flight");
        clients.post(id, Request::Ack { seq: 77 });
        assert!(is_idle(&clients), "no such frame");
        clients.post(id, Request::Ack { seq: 4 });
        assert_eq!(render(&clients, 0.01), (id, 9));
        assert!((0..3).all(|_| messages.try_recv().is_ok()) && messages.try_recv().is_err());
    }

    #[test]
    fn a_client_that_reads_nothing_gets_no_more_work() {
        let clients = Clients::default();
        let (id, _messages) = clients.add().unwrap();
        let open = OpenRequest { scene: 0, stored: None };
        for _ in 0..MAX_QUEUED {
            clients.post(id, Request::Open(open));
            assert_eq!(clients.next_job(), Some((id, Job::Open(open))));
            clients.finish(id, 0.0, Vec::new(), None);
        }
        clients.post(id, Request::Open(open));
        assert!(is_idle(&clients));
    }

    #[test]
    fn tabs_share_device_time_not_frames() {
        let clients = Clients::default();
        let (slow, mut a) = clients.add().unwrap();
        let (mut used, mut counts) = ([0.0; 2], [0; 2]);
        // The first tab worked alone for a while, which must not cost it anything later.
        clients.post(slow, view(0));
        render(&clients, 5.0);
        clients.post(slow, Request::Ack { seq: 0 });
        let (fast, mut b) = clients.add().unwrap();
        let cost = |id| if id == slow { 0.03 } else { 0.01 };
        for seq in 0..400 {
            for id in [slow, fast] {
                clients.post(id, view(seq));
            }
            let Some((id, Job::View(..))) = clients.next_job() else { panic!("a view") };
            clients.finish(id, cost(id), Vec::new(), None);
            let _ = if id == slow { a.try_recv() } else { b.try_recv() };
            let index = usize::from(id == fast);
            (used[index], counts[index]) = (used[index] + cost(id), counts[index] + 1);
        }
        assert!((used[0] / used[1] - 1.0).abs() < 0.05, "{used:?} s for {counts:?} frames");
    }

    #[test]
    fn removed_clients_leave_nothing_behind_and_the_number_is_bounded() {
        let clients = Clients::default();
        let ids: Vec<_> = (0..MAX_CLIENTS).map(|_| clients.add().unwrap()).collect();
        assert!(clients.add().is_none());
        clients.post(ids[3].0, view(1));
        clients.remove(ids[3].0);
        assert_eq!(clients.next_job(), Some((ids[3].0, Job::Forget)));
        assert!(is_idle(&clients));
        clients.post(ids[3].0, view(2));
        clients.finish(ids[3].0, 1.0, Vec::new(), None);
        assert!(clients.add().is_some());
        clients.close();
        assert_eq!(clients.next_job(), None);
    }
}
