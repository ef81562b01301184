//! A plot as inline SVG: points with error bars, joined or not, over two axes. Colours are the page's.

use std::io::{self, Write};

use super::axis::{Axis, Scale};
use super::markup::Escaped;

// Small enough that the text can still be read where the plot is shrunk to the width of a phone.
const WIDTH: f64 = 460.0;
const HEIGHT: f64 = 320.0;
const LEFT: f64 = 56.0;
const RIGHT: f64 = 12.0;
const TOP: f64 = 12.0;
const BOTTOM: f64 = 48.0;

/// How a series is drawn: a class of the style sheet for its colour, and a marker for those who cannot tell colours.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Look {
    /// Class of the style sheet.
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

    /// Looks of other systems.
    pub const OTHERS: [Self; 3] = [
        Self { class: "c5", marker: "M-5 -1.6H-1.6V-5H1.6V-1.6H5V1.6H1.6V5H-1.6V1.6H-5z" },
        Self { class: "c6", marker: "M-2.8 -4.9H2.8L5.6 0L2.8 4.9H-2.8L-5.6 0z" },
        Self { class: "c7", marker: "M-5 -2.4H5V2.4H-5z" },
    ];
}

/// One measured value.
#[derive(Clone, Debug, PartialEq)]
pub struct Mark {
    /// Along the horizontal axis.
    pub x: f64,
    /// Along the vertical axis.
    pub y: f64,
    /// Half the length of its error bar.
    pub error: Option<f64>,
    /// What a pointer that rests on it is told.
    pub title: String,
}

/// Values that belong together.
#[derive(Clone, Debug, PartialEq)]
pub struct Series {
    /// Name in the legend.
    pub name: String,
    /// Colour and marker.
    pub look: Look,
    /// Whether its marks are joined, in their order.
    pub is_joined: bool,
    /// The values.
    pub marks: Vec<Mark>,
}

/// A value to compare with: a line across the plot.
#[derive(Clone, Debug, PartialEq)]
pub struct Level {
    /// Name in the legend.
    pub name: String,
    /// Class of the style sheet.
    pub class: &'static str,
    /// Along the vertical axis.
    pub y: f64,
}

/// A plot to be drawn.
#[derive(Clone, Debug, PartialEq)]
pub struct Plot {
    /// What it shows, for those who cannot see it.
    pub title: String,
    /// Label of the horizontal axis, with its unit.
    pub x_label: &'static str,
    /// Spread of the horizontal axis.
    pub x_scale: Scale,
    /// Label of the vertical axis, with its unit.
    pub y_label: &'static str,
    /// What is drawn.
    pub series: Vec<Series>,
    /// Lines across.
    pub levels: Vec<Level>,
    /// A staircase through these points: the Pareto front, by rising x.
    pub front: Vec<(f64, f64)>,
}

impl Plot {
    /// Writes the SVG, or a sentence where there is nothing to draw.
    ///
    /// # Errors
    /// The writer's.
    pub fn write(&self, out: &mut impl Write) -> io::Result<()> {
        let marks = || self.series.iter().flat_map(|series| &series.marks);
        let ends = |mark: &Mark| {
            let error = mark.error.unwrap_or_default();
            [mark.y - error, mark.y + error]
        };
        let x_axis = Axis::new(self.x_scale, marks().map(|mark| mark.x));
        let levels = self.levels.iter().map(|level| level.y);
        let y_axis = Axis::new(Scale::Linear, marks().flat_map(ends).chain(levels));
        let (Some(x_axis), Some(y_axis)) = (x_axis, y_axis) else {
            return writeln!(out, "<p class=\"none\">Nothing was measured that could be drawn here.</p>");
        };
        let x = |value: f64| LEFT + x_axis.place(value) * (WIDTH - LEFT - RIGHT);
        let y = |value: f64| HEIGHT - BOTTOM - y_axis.place(value) * (HEIGHT - TOP - BOTTOM);
        let (right, bottom) = (WIDTH - RIGHT, HEIGHT - BOTTOM);

        write!(out, "<svg class=\"plot\" viewBox=\"0 0 {WIDTH} {HEIGHT}\" role=\"img\" ")?;
        writeln!(out, "aria-label=\"{0}\"><title>{0}</title>", Escaped(&self.title))?;
        for (tick, label) in y_axis.ticks() {
            let y = y(tick);
            write!(out, "<path class=\"grid\" d=\"M{LEFT} {y:.1}H{right}\"/>")?;
            writeln!(
                out,
                "<text class=\"tick\" x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"end\">{label}</text>",
                LEFT - 7.0,
                y + 4.0
            )?;
        }
        writeln!(out, "<path class=\"axis\" d=\"M{LEFT} {bottom}H{right}\"/>")?;
        for (tick, label) in x_axis.ticks() {
            let x = x(tick);
            write!(out, "<path class=\"axis\" d=\"M{x:.1} {bottom}v5\"/>")?;
            writeln!(
                out,
                "<text class=\"tick\" x=\"{x:.1}\" y=\"{:.1}\" text-anchor=\"middle\">{label}</text>",
                bottom + 19.0
            )?;
        }
        let (middle, foot) = (f64::midpoint(LEFT, right), HEIGHT - 8.0);
        writeln!(
            out,
            "<text class=\"label\" x=\"{middle}\" y=\"{foot}\" text-anchor=\"middle\">{}</text>",
            self.x_label
        )?;
        let middle = f64::midpoint(TOP, bottom);
        writeln!(
            out,
            "<text class=\"label\" transform=\"translate(14 {middle}) rotate(-90)\" text-anchor=\"middle\">{}</text>",
            self.y_label
        )?;

        for level in &self.levels {
            writeln!(out, "<path class=\"level {}\" d=\"M{LEFT} {:.1}H{right}\"/>", level.class, y(level.y))?;
        }
        if let Some(((first_x, first_y), rest)) = self.front.split_first() {
            write!(out, "<path class=\"front\" d=\"M{:.1} {:.1}", x(*first_x), y(*first_y))?;
            for (next_x, next_y) in rest {
                write!(out, "H{:.1}V{:.1}", x(*next_x), y(*next_y))?;
            }
            writeln!(out, "\"/>")?;
            for (front_x, front_y) in &self.front {
                writeln!(out, "<circle class=\"front\" cx=\"{:.1}\" cy=\"{:.1}\" r=\"8\"/>", x(*front_x), y(*front_y))?;
            }
        }
        // The first, which is the method, on top.
        for series in self.series.iter().rev() {
            series.write(out, &x, &y)?;
        }
        writeln!(out, "</svg>")?;
        self.write_legend(out)
    }

    fn write_legend(&self, out: &mut impl Write) -> io::Result<()> {
        write!(out, "<ul class=\"legend\">")?;
        for Series { name, look: Look { class, marker }, is_joined, .. } in &self.series {
            let line = if *is_joined { "<path class=\"line\" d=\"M-12 0H12\"/>" } else { "" };
            write!(
                out,
                "<li>{KEY}<g class=\"{class}\">{line}<path class=\"mark\" d=\"{marker}\"/></g></svg>{}</li>",
                Escaped(name)
            )?;
        }
        for Level { name, class, .. } in &self.levels {
            write!(out, "<li>{KEY}<path class=\"level {class}\" d=\"M-12 0H12\"/></svg>{}</li>", Escaped(name))?;
        }
        if !self.front.is_empty() {
            write!(out, "<li>{KEY}<path class=\"front\" d=\"M-12 5H0V-5H12\"/></svg>Pareto front</li>")?;
        }
        writeln!(out, "</ul>")
    }
}

/// The start of a picture in a legend.
const KEY: &str = "<svg class=\"key\" viewBox=\"-14 -8 28 16\" aria-hidden=\"true\">";

impl Series {
    fn write(&self, out: &mut impl Write, x: &impl Fn(f64) -> f64, y: &impl Fn(f64) -> f64) -> io::Result<()> {
        let Self { look: Look { class, marker }, is_joined, marks, .. } = self;
        writeln!(out, "<g class=\"{class}\">")?;
        for mark in marks {
            let Some(error) = mark.error.filter(|error| *error > 0.0) else { continue };
            let (x, low, high) = (x(mark.x), y(mark.y - error), y(mark.y + error));
            let (left, right) = (x - 4.0, x + 4.0);
            writeln!(
                out,
                "<path class=\"error\" d=\"M{x:.1} {low:.1}V{high:.1}M{left:.1} {low:.1}H{right:.1}M{left:.1} {high:.1}H{right:.1}\"/>"
            )?;
        }
        if *is_joined && marks.len() > 1 {
            let points: Vec<String> = marks.iter().map(|mark| format!("{:.1},{:.1}", x(mark.x), y(mark.y))).collect();
            writeln!(out, "<polyline class=\"line\" points=\"{}\"/>", points.join(" "))?;
        }
        for mark in marks {
            let (x, y, title) = (x(mark.x), y(mark.y), Escaped(&mark.title));
            writeln!(
                out,
                "<path class=\"mark\" transform=\"translate({x:.1} {y:.1})\" d=\"{marker}\"><title>{title}</title></path>"
            )?;
        }
        writeln!(out, "</g>")
    }
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
            y_label: "PSNR, dB",
            series: vec![series],
            levels: vec![Level { name: "nearest view".into(), class: "nearest", y: 12.0 }],
            front: vec![(8.0, 14.0), (16.0, 18.0)],
        }
    }

    fn text(plot: &Plot) -> String {
        let mut out = Vec::new();
        plot.write(&mut out).unwrap();
        String::from_utf8(out).unwrap()
    }

    #[test]
    fn a_plot_has_labels_marks_error_bars_a_legend_and_escaped_names() {
        let svg = text(&plot(vec![mark(8.0, 14.0), mark(16.0, 18.0)]));
        assert_eq!(svg.matches("class=\"mark\" transform").count(), 2);
        assert_eq!(svg.matches("class=\"error\"").count(), 2);
        assert_eq!(svg.matches("<circle class=\"front\"").count(), 2);
        for part in
            ["quality &amp; tokens", "a &lt; b", ">tokens</text>", ">PSNR, dB</text>", ">8</text>", ">16</text>"]
        {
            assert!(svg.contains(part), "{part}: {svg}");
        }
        assert!(svg.contains("nearest view") && svg.contains("Pareto front"));
    }

    #[test]
    fn marks_and_error_bars_lie_within_the_axes() {
        let svg = text(&plot(vec![mark(8.0, 14.0), mark(16.0, 18.0), mark(4096.0, 30.0)]));
        for place in svg.split("translate(").skip(2) {
            let (x, y) = place.split_once(')').unwrap().0.split_once(' ').unwrap();
            let (x, y): (f64, f64) = (x.parse().unwrap(), y.parse().unwrap());
            assert!((LEFT..=WIDTH - RIGHT).contains(&x) && (TOP..=HEIGHT - BOTTOM).contains(&y), "({x}, {y})");
        }
        assert!(!svg.contains("NaN") && !svg.contains("inf"), "{svg}");
    }

    #[test]
    fn a_plot_of_nothing_says_so() {
        assert!(text(&plot(Vec::new())).contains("Nothing was measured"));
        assert!(text(&plot(vec![Mark { x: f64::NAN, ..mark(0.0, 1.0) }])).contains("Nothing was measured"));
    }
}
