//! The memory of a backward pass: what every part keeps until its turn, what it needs at its turn, what it leaves.

/// A part of the network in the order of the forward pass; numbers of f32 values.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Part {
    /// Kept from the forward until the part's backward is done.
    pub kept: f64,
    /// Needed on top while its backward runs: gradients on their way, and what is computed again.
    pub working: f64,
    /// Needed on top while its forward runs.
    pub forward: f64,
    /// Parameters whose gradients it leaves behind.
    pub parameters: f64,
}

/// Most values alive at once: the forward adds what is kept, the backward, from the end, gives it back and leaves
/// gradients of parameters.
pub fn peak(parts: &[Part]) -> f64 {
    let (mut kept, mut most) = (0.0_f64, 0.0_f64);
    for part in parts {
        most = most.max(kept + part.forward.max(part.kept));
        kept += part.kept;
    }
    let mut gradients = 0.0;
    for part in parts.iter().rev() {
        gradients += part.parameters;
        most = most.max(kept + part.working + gradients);
        kept -= part.kept;
    }
    most
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_peak_is_where_the_kept_the_working_and_the_gradients_are_most() {
        let part = |kept, working, forward, parameters| Part { kept, working, forward, parameters };
        assert_eq!(peak(&[]), 0.0);
        // At the start of the backward.
        assert_eq!(peak(&[part(5.0, 1.0, 0.0, 1.0), part(5.0, 2.0, 0.0, 1.0)]), 13.0);
        // At its end, by the gradients.
        assert_eq!(peak(&[part(1.0, 1.0, 0.0, 10.0), part(1.0, 1.0, 0.0, 10.0)]), 22.0);
        // In the forward.
        assert_eq!(peak(&[part(1.0, 0.0, 9.0, 0.0), part(2.0, 1.0, 0.0, 0.0)]), 9.0);
    }
}
