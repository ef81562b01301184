//! A plot of PSNR as inline SVG: points with error bars, joined or not, over two axes. The style sheet has the colours.

use maud::{Markup, html};

// Small enough for readable text where the plot shrinks to the width of a phone.
const WIDTH: f64 = 460.0;
const HEIGHT: f64 = 320.0;
const LEFT: f64 = 64.0;
const RIGHT: f64 = 24.0;
const TOP: f64 = 12.0;
const BOTTOM: f64 = 48.0;

/// Free share of the range at either end of an axis.
const PADDING: f64 = 0.06;
const MAX_TICKS: usize = 8;

/// Paths of the markers around (0, 0). Colour and marker both tell series apart.
const MARKERS: [&str; 5] = [
    "M-4.5 0a4.5 4.5 0 1 0 9 0a4.5 4.5 0 1 0 -9 0z",
    "M-4 -4h8v8h-8z",
    "M0 -5.2L5 3.8H-5z",
    "M0 -5.6L5.6 0L0 5.6L-5.6 0z",
    "M-5 -1.6H-1.6V-5H1.6V-1.6H5V1.6H1.6V5H-1.6V1.6H-5z",
];
/// Colours of the style sheet.
const NUM_COLOURS: usize = 8;

#[derive(Clone, Debug)]
pub struct Mark {
    pub x: f64,
    pub y: f64,
    /// Half the length of the error bar.
    pub error: Option<f64>,
    /// Whether the mark has a ring: it is on the Pareto front.
    pub is_front: bool,
    pub title: String,
}

/// Marks with one look and one legend entry.
#[derive(Clone, Debug)]
pub struct Series {
    pub name: String,
    /// Numbers of colour and marker.
    pub look: [usize; 2],
    pub is_joined: bool,
    pub marks: Vec<Mark>,
}

#[derive(Clone, Debug, Default)]
pub struct Plot {
    pub heading: &'static str,
    pub x_label: &'static str,
    pub is_log: bool,
    /// Series of marks. The first series is on top.
    pub series: Vec<Series>,
    /// Horizontal lines with their names, such as baselines.
    pub levels: Vec<(&'static str, f64)>,
    /// Note below the plot; may be empty.
    pub note: String,
}

impl Plot {
    pub fn to_html(&self) -> Markup {
        html! {
            section {
                h3 { (self.heading) }
                (self.svg())
                ul.legend {
                    @for series in &self.series {
                        li { svg.key viewBox="-14 -8 28 16" aria-hidden="true" { (series.symbol()) } (series.name) }
                    }
                }
                @if !self.note.is_empty() { p.note { (self.note) } }
            }
        }
    }

    fn svg(&self) -> Markup {
        let marks = || self.series.iter().flat_map(|series| &series.marks);
        let ends = |mark: &Mark| [-1.0, 1.0].map(|side| mark.y + side * mark.error.unwrap_or_default());
        let levels = self.levels.iter().map(|(_, level)| *level);
        let x_axis = Axis::new(self.is_log, marks().map(|mark| mark.x));
        let y_axis = Axis::new(false, marks().flat_map(ends).chain(levels));
        let (Some(x_axis), Some(y_axis)) = (x_axis, y_axis) else {
            return html! { p.none { "No measured points." } };
        };
        let x = |value: f64| LEFT + x_axis.position(value) * (WIDTH - LEFT - RIGHT);
        let y = |value: f64| HEIGHT - BOTTOM - y_axis.position(value) * (HEIGHT - TOP - BOTTOM);
        let (right, bottom) = (WIDTH - RIGHT, HEIGHT - BOTTOM);
        let (middle_x, middle_y) = (f64::midpoint(LEFT, right), f64::midpoint(TOP, bottom));
        let title = format!("PSNR against {}", self.x_label);
        html! {
            svg.plot viewBox={ "0 0 " (WIDTH) " " (HEIGHT) } role="img" aria-label=(title) {
                @for &tick in &y_axis.ticks {
                    path.grid d=(format!("M{LEFT} {:.1}H{right}", y(tick))) {}
                    text.tick x=(LEFT - 7.0) y=(format!("{:.1}", y(tick) + 4.0)) text-anchor="end" { (label(tick)) }
                }
                path.axis d=(format!("M{LEFT} {bottom}H{right}")) {}
                @for &tick in &x_axis.ticks {
                    path.axis d=(format!("M{:.1} {bottom}v5", x(tick))) {}
                    text.tick x=(format!("{:.1}", x(tick))) y=(bottom + 19.0) text-anchor="middle" { (label(tick)) }
                }
                text.label x=(middle_x) y=(HEIGHT - 8.0) text-anchor="middle" { (self.x_label) }
                text.label transform=(format!("translate(14 {middle_y}) rotate(-90)")) text-anchor="middle" {
                    "PSNR, dB"
                }
                @for (name, level) in &self.levels {
                    path.level d=(format!("M{LEFT} {:.1}H{right}", y(*level))) {}
                    text.tick x=(right) y=(format!("{:.1}", y(*level) - 4.0)) text-anchor="end" { (name) }
                }
                @for series in self.series.iter().rev() { (series.to_html(x, y)) }
            }
        }
    }
}

impl Series {
    fn class(&self) -> String {
        format!("c{}", self.look[0] % NUM_COLOURS)
    }

    fn marker(&self) -> &'static str {
        MARKERS[self.look[1] % MARKERS.len()]
    }

    fn symbol(&self) -> Markup {
        html! {
            g class=(self.class()) {
                @if self.is_joined { path.line d="M-12 0H12" {} }
                path.mark d=(self.marker()) {}
            }
        }
    }

    fn to_html(&self, x: impl Fn(f64) -> f64, y: impl Fn(f64) -> f64) -> Markup {
        let points: Vec<String> = self.marks.iter().map(|mark| format!("{:.1},{:.1}", x(mark.x), y(mark.y))).collect();
        let place = |mark: &Mark| format!("translate({:.1} {:.1})", x(mark.x), y(mark.y));
        html! {
            g class=(self.class()) {
                @if self.is_joined { polyline.line points=(points.join(" ")) {} }
                @for mark in &self.marks {
                    @if let Some(error) = mark.error {
                        path.error d=(format!("M{:.1} {:.1}V{:.1}", x(mark.x), y(mark.y - error), y(mark.y + error))) {}
                    }
                    @if mark.is_front { circle.front transform=(place(mark)) r="8" {} }
                    path.mark transform=(place(mark)) d=(self.marker()) { title { (mark.title) } }
                }
            }
        }
    }
}

struct Axis {
    is_log: bool,
    /// Ends of the range, logarithms of base 10 on a logarithmic axis.
    ends: [f64; 2],
    ticks: Vec<f64>,
}

impl Axis {
    /// Returns an axis over all values; `None` without a finite (for logarithms: positive) value.
    fn new(is_log: bool, values: impl Iterator<Item = f64>) -> Option<Self> {
        let along: Vec<f64> =
            values.map(|value| if is_log { value.log10() } else { value }).filter(|value| value.is_finite()).collect();
        let (low, high) = (along.iter().copied().reduce(f64::min)?, along.iter().copied().reduce(f64::max)?);
        // A single value is in the middle.
        let padding = if high > low { (high - low) * PADDING } else { 0.5 };
        let (low, high) = (low - padding, high + padding);
        let ticks = if is_log { log_ticks(low, high) } else { linear_ticks(low, high) };
        Some(Self { is_log, ends: [low, high], ticks })
    }

    /// Returns the position of a value: 0 at the start of the axis, 1 at the end.
    fn position(&self, value: f64) -> f64 {
        let [low, high] = self.ends;
        ((if self.is_log { value.log10() } else { value }) - low) / (high - low)
    }
}

/// Returns the multiples of 1, 2 or 5 times a power of ten within a range, at most [`MAX_TICKS`].
fn linear_ticks(low: f64, high: f64) -> Vec<f64> {
    let least = (high - low) / (MAX_TICKS - 1) as f64;
    let power = 10_f64.powf(least.log10().floor());
    let steps = [1.0, 2.0, 5.0].map(|factor| factor * power);
    let step = steps.into_iter().find(|step| *step >= least).unwrap_or(10.0 * power);
    ((low / step).ceil() as i64..=(high / step).floor() as i64).map(|i| i as f64 * step).collect()
}

/// Returns the powers of ten within a range, with their multiples by 2 and 5 where at most [`MAX_TICKS`] result. A range with
/// fewer than three such ticks has linear ticks. The ends are logarithms.
fn log_ticks(low: f64, high: f64) -> Vec<f64> {
    for factors in [&[1.0, 2.0, 5.0][..], &[1.0]] {
        let powers = low.floor() as i32..=high.ceil() as i32;
        let ticks = powers.flat_map(|power| factors.iter().map(move |factor| factor * 10_f64.powi(power)));
        let ticks: Vec<f64> = ticks.filter(|tick| (low..=high).contains(&tick.log10())).collect();
        if (3..=MAX_TICKS).contains(&ticks.len()) {
            return ticks;
        }
    }
    linear_ticks(10_f64.powf(low), 10_f64.powf(high))
}

/// Returns the text of a tick without the rounding of its last bits.
fn label(tick: f64) -> String {
    ((tick * 1e9).round() / 1e9).to_string()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ticks_are_round_numbers_within_the_axis() {
        for (is_log, values, expected) in [
            (false, &[14.2, 18.1][..], "14 15 16 17 18"),
            (false, &[0.31, 0.52], "0.3 0.35 0.4 0.45 0.5"),
            (false, &[-3.0, 3.0], "-3 -2 -1 0 1 2 3"),
            (true, &[7.0, 90.0], "10 20 50 100"),
            (true, &[0.5, 20_000.0], "1 10 100 1000 10000"),
            (true, &[11.0, 14.0], "11 11.5 12 12.5 13 13.5 14"),
            (true, &[0.0, 8.0, f64::NAN], "5 10 20"),
        ] {
            let axis = Axis::new(is_log, values.iter().copied()).unwrap();
            let labels: Vec<String> = axis.ticks.iter().copied().map(label).collect();
            assert_eq!(labels.join(" "), expected, "{values:?}");
            assert!(axis.ticks.iter().all(|tick| (0.0..=1.0).contains(&axis.position(*tick))));
        }
        assert!(Axis::new(false, [f64::NAN, f64::INFINITY].into_iter()).is_none());
        assert!(Axis::new(true, [0.0, -1.0].into_iter()).is_none());
    }

    #[test]
    fn marks_lie_within_the_axes_and_names_are_escaped() {
        let mark = |x: f64| Mark { x, y: x.sqrt(), error: Some(0.5), is_front: x < 20.0, title: "a < b".into() };
        let series =
            Series { name: "a & b".into(), look: [0, 0], is_joined: true, marks: [8.0, 16.0, 4096.0].map(mark).into() };
        let mut plot =
            Plot { is_log: true, series: vec![series], levels: vec![("nearest view", 12.0)], ..Plot::default() };
        let svg = plot.to_html().into_string();
        let counts =
            ["class=\"mark\" transform", "class=\"error\"", "<circle class=\"front\"", "a &lt; b", "a &amp; b"];
        assert_eq!(counts.map(|part| svg.matches(part).count()), [3, 3, 2, 3, 1], "{svg}");
        for position in svg.split("translate(").skip(2) {
            let (x, y) = position.split_once(')').unwrap().0.split_once(' ').unwrap();
            let (x, y): (f64, f64) = (x.parse().unwrap(), y.parse().unwrap());
            assert!((LEFT..=WIDTH - RIGHT).contains(&x) && (TOP..=HEIGHT - BOTTOM).contains(&y), "({x}, {y})");
        }
        assert!(!svg.contains("NaN") && !svg.contains("inf"), "{svg}");
        plot.series.clear();
        assert!(plot.to_html().into_string().contains("No measured points"));
    }
}
