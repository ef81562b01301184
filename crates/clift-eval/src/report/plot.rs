//! A plot of PSNR as inline SVG: points with error bars, joined or not, over two axes. The style sheet has the colours.

use std::fmt::Write;

use maud::{Markup, html};

use crate::report::axis::{Axis, Scale};

// Small enough for readable text where the plot shrinks to the width of a phone.
const WIDTH: f64 = 460.0;
const HEIGHT: f64 = 320.0;
const LEFT: f64 = 64.0;
// Half of a label such as `1,000` fits beyond the last tick.
const RIGHT: f64 = 24.0;
const TOP: f64 = 12.0;
const BOTTOM: f64 = 48.0;

/// Colour and marker of a series. The marker identifies a series without colour.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Look {
    pub class: &'static str,
    /// Path of the marker around (0, 0).
    pub marker: &'static str,
}

impl Look {
    /// Looks that differ in colour and shape.
    pub const ALL: [Self; 5] = [
        Self { class: "c0", marker: "M-4.5 0a4.5 4.5 0 1 0 9 0a4.5 4.5 0 1 0 -9 0z" },
        Self { class: "c1", marker: "M-4 -4h8v8h-8z" },
        Self { class: "c2", marker: "M0 -5.2L5 3.8H-5z" },
        Self { class: "c3", marker: "M0 -5.6L5.6 0L0 5.6L-5.6 0z" },
        Self { class: "c4", marker: "M-5 -3.8H5L0 5.2z" },
    ];

    /// A line without markers.
    pub const LINE: Self = Self { class: "c2", marker: "M0 0" };

    /// Looks of external methods.
    pub const OTHERS: [Self; 3] = [
        Self { class: "c5", marker: "M-5 -1.6H-1.6V-5H1.6V-1.6H5V1.6H1.6V5H-1.6V1.6H-5z" },
        Self { class: "c6", marker: "M-2.8 -4.9H2.8L5.6 0L2.8 4.9H-2.8L-5.6 0z" },
        Self { class: "c7", marker: "M-5 -2.4H5V2.4H-5z" },
    ];
}

#[derive(Clone, Debug, PartialEq)]
pub struct Mark {
    pub x: f64,
    pub y: f64,
    /// Half the length of the error bar.
    pub error: Option<f64>,
    pub title: String,
}

/// Marks with one look and one legend entry.
#[derive(Clone, Debug, PartialEq)]
pub struct Series {
    pub name: String,
    pub look: Look,
    /// Whether a line joins the marks, in their order.
    pub is_joined: bool,
    pub marks: Vec<Mark>,
}

/// A horizontal line across the plot, such as a baseline.
#[derive(Clone, Debug, PartialEq)]
pub struct Level {
    pub name: String,
    pub class: &'static str,
    pub y: f64,
}

#[derive(Clone, Debug, Default, PartialEq)]
pub struct Plot {
    pub heading: &'static str,
    /// Description for screen readers.
    pub title: String,
    pub x_label: &'static str,
    pub x_scale: Scale,
    /// Series of marks. The first series is on top.
    pub series: Vec<Series>,
    pub levels: Vec<Level>,
    /// Points of the Pareto front by ascending x, joined as a staircase; may be empty.
    pub front: Vec<(f64, f64)>,
    /// Note below the plot; may be empty.
    pub note: &'static str,
}

impl Plot {
    pub fn to_html(&self) -> Markup {
        let marks = || self.series.iter().flat_map(|series| &series.marks);
        let ends = |mark: &Mark| {
            let error = mark.error.unwrap_or_default();
            [mark.y - error, mark.y + error]
        };
        let x_axis = Axis::new(self.x_scale, marks().map(|mark| mark.x));
        let levels = self.levels.iter().map(|level| level.y);
        let y_axis = Axis::new(Scale::Linear, marks().flat_map(ends).chain(levels));
        let (Some(x_axis), Some(y_axis)) = (x_axis, y_axis) else {
            return html! { p.none { "No measured points." } };
        };
        let x = |value: f64| LEFT + x_axis.position(value) * (WIDTH - LEFT - RIGHT);
        let y = |value: f64| HEIGHT - BOTTOM - y_axis.position(value) * (HEIGHT - TOP - BOTTOM);
        let (right, bottom) = (WIDTH - RIGHT, HEIGHT - BOTTOM);
        let (middle_x, middle_y) = (f64::midpoint(LEFT, right), f64::midpoint(TOP, bottom));
        html! {
            svg.plot viewBox={ "0 0 " (WIDTH) " " (HEIGHT) } role="img" aria-label=(self.title) {
                title { (self.title) }
                @for (tick, label) in y_axis.ticks() {
                    @let y = y(tick);
                    path.grid d=(format!("M{LEFT} {y:.1}H{right}")) {}
                    text.tick x=(tenths(LEFT - 7.0)) y=(tenths(y + 4.0)) text-anchor="end" { (label) }
                }
                path.axis d=(format!("M{LEFT} {bottom}H{right}")) {}
                @for (tick, label) in x_axis.ticks() {
                    @let x = x(tick);
                    path.axis d=(format!("M{x:.1} {bottom}v5")) {}
                    text.tick x=(tenths(x)) y=(tenths(bottom + 19.0)) text-anchor="middle" { (label) }
                }
                text.label x=(middle_x) y=(HEIGHT - 8.0) text-anchor="middle" { (self.x_label) }
                text.label transform=(format!("translate(14 {middle_y}) rotate(-90)")) text-anchor="middle" {
                    "PSNR, dB"
                }
                @for Level { class, y: level, .. } in &self.levels {
                    path class={ "level " (class) } d=(format!("M{LEFT} {:.1}H{right}", y(*level))) {}
                }
                @if !self.front.is_empty() {
                    path.front d=(staircase(self.front.iter().map(|point| (x(point.0), y(point.1))))) {}
                }
                @for (front_x, front_y) in &self.front {
                    circle.front cx=(tenths(x(*front_x))) cy=(tenths(y(*front_y))) r="8" {}
                }
                // The first series, the main method, is on top.
                @for series in self.series.iter().rev() { (series.to_html(x, y)) }
            }
            (self.legend())
        }
    }

    fn legend(&self) -> Markup {
        let key = |symbol: Markup| html! { svg.key viewBox="-14 -8 28 16" aria-hidden="true" { (symbol) } };
        html! {
            ul.legend {
                @for Series { name, look: Look { class, marker }, is_joined, .. } in &self.series {
                    li {
                        (key(html! {
                            g class=(class) {
                                @if *is_joined { path.line d="M-12 0H12" {} }
                                path.mark d=(marker) {}
                            }
                        }))
                        (name)
                    }
                }
                @for Level { name, class, .. } in &self.levels {
                    li { (key(html! { path class={ "level " (class) } d="M-12 0H12" {} })) (name) }
                }
                @if !self.front.is_empty() {
                    li { (key(html! { path.front d="M-12 5H0V-5H12" {} })) "Pareto front" }
                }
            }
        }
    }
}

impl Series {
    fn to_html(&self, x: impl Fn(f64) -> f64, y: impl Fn(f64) -> f64) -> Markup {
        let Self { look: Look { class, marker }, is_joined, marks, .. } = self;
        let points: Vec<String> = marks.iter().map(|mark| format!("{:.1},{:.1}", x(mark.x), y(mark.y))).collect();
        html! {
            g class=(class) {
                @for mark in marks {
                    @if let Some(error) = mark.error.filter(|error| *error > 0.0) {
                        path.error d=(error_bar(x(mark.x), y(mark.y - error), y(mark.y + error))) {}
                    }
                }
                @if *is_joined && marks.len() > 1 { polyline.line points=(points.join(" ")) {} }
                @for mark in marks {
                    path.mark transform=(format!("translate({:.1} {:.1})", x(mark.x), y(mark.y))) d=(marker) {
                        title { (mark.title) }
                    }
                }
            }
        }
    }
}

fn tenths(value: f64) -> String {
    format!("{value:.1}")
}

/// Returns the path of an upright bar with its two ends.
fn error_bar(x: f64, low: f64, high: f64) -> String {
    let (left, right) = (x - 4.0, x + 4.0);
    format!("M{x:.1} {low:.1}V{high:.1}M{left:.1} {low:.1}H{right:.1}M{left:.1} {high:.1}H{right:.1}")
}

/// Returns the path of a staircase through points by ascending x.
fn staircase(points: impl Iterator<Item = (f64, f64)>) -> String {
    let mut path = String::new();
    for (i, (x, y)) in points.enumerate() {
        let _ = if i == 0 { write!(path, "M{x:.1} {y:.1}") } else { write!(path, "H{x:.1}V{y:.1}") };
    }
    path
}

#[cfg(test)]
mod tests {
    use super::*;

    fn mark(x: f64, y: f64) -> Mark {
        Mark { x, y, error: Some(0.5), title: format!("{y} dB") }
    }

    fn plot(marks: Vec<Mark>) -> Plot {
        let series = Series { name: "a < b".into(), look: Look::ALL[0], is_joined: true, marks };
        Plot {
            title: "quality & tokens".into(),
            x_label: "tokens",
            x_scale: Scale::LogValues,
            series: vec![series],
            levels: vec![Level { name: "nearest view".into(), class: "nearest", y: 12.0 }],
            front: vec![(8.0, 14.0), (16.0, 18.0)],
            ..Plot::default()
        }
    }

    fn text(plot: &Plot) -> String {
        plot.to_html().into_string()
    }

    #[test]
    fn marks_lie_within_the_axes_and_names_are_escaped() {
        let svg = text(&plot(vec![mark(8.0, 14.0), mark(16.0, 18.0), mark(4096.0, 30.0)]));
        let counts = ["class=\"mark\" transform", "class=\"error\"", "<circle class=\"front\""];
        assert_eq!(counts.map(|part| svg.matches(part).count()), [3, 3, 2]);
        for part in ["quality &amp; tokens", "a &lt; b", ">tokens</text>", ">PSNR, dB</text>", ">8</text>"] {
            assert!(svg.contains(part), "{part}: {svg}");
        }
        for position in svg.split("translate(").skip(2) {
            let (x, y) = position.split_once(')').unwrap().0.split_once(' ').unwrap();
            let (x, y): (f64, f64) = (x.parse().unwrap(), y.parse().unwrap());
            assert!((LEFT..=WIDTH - RIGHT).contains(&x) && (TOP..=HEIGHT - BOTTOM).contains(&y), "({x}, {y})");
        }
        assert!(!svg.contains("NaN") && !svg.contains("inf"), "{svg}");
    }

    #[test]
    fn plots_without_points_have_a_sentence() {
        assert!(text(&plot(Vec::new())).contains("No measured points"));
        assert!(text(&plot(vec![Mark { x: f64::NAN, ..mark(0.0, 1.0) }])).contains("No measured points"));
    }
}
