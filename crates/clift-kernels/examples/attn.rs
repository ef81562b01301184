use clift_kernels::InstructionSet;
use clift_kernels::attention::*;
use std::time::Instant;
fn main() {
    for (name, sizes) in [
        ("full", Sizes { batch: 1, num_queries: 4096, num_keys: 4096, num_heads: 8, head_width: 96 }),
        ("cross", Sizes { batch: 1, num_queries: 1024, num_keys: 4096, num_heads: 8, head_width: 96 }),
        ("tiny", Sizes { batch: 8, num_queries: 256, num_keys: 256, num_heads: 8, head_width: 16 }),
    ] {
        for set in InstructionSet::available() {
            let d = sizes.num_heads * sizes.head_width;
            let mk = |n: usize| {
                (0..sizes.batch * n * d).map(|i| ((i * 7919) % 1013) as f32 / 506.0 - 1.0).collect::<Vec<f32>>()
            };
            let (q, k, v, g) = (mk(sizes.num_queries), mk(sizes.num_keys), mk(sizes.num_keys), mk(sizes.num_queries));
            fn id<'a>(x: &'a [f32], n: usize, d: usize) -> Rows<'a> {
                Rows { values: x, batch_stride: n * d, row_stride: d }
            }
            let nn = (sizes.num_queries, sizes.num_keys);
            macro_rules! rq {
                ($x:expr) => {
                    id($x, nn.0, d)
                };
            }
            macro_rules! rk {
                ($x:expr) => {
                    id($x, nn.1, d)
                };
            }
            // let rq = |x| Rows { values: x, batch_stride: sizes.num_queries * d, row_stride: d };
            // let rk = |x| Rows { values: x, batch_stride: sizes.num_keys * d, row_stride: d };
            let mut o = vec![0.0; q.len()];
            let mut lse = vec![0.0; sizes.batch * sizes.num_heads * sizes.num_queries];
            let (mut gq, mut gk, mut gv) = (vec![0.0; q.len()], vec![0.0; k.len()], vec![0.0; k.len()]);
            let mut tf = vec![];
            let mut tb = vec![];
            let reps = if name == "tiny" { 50 } else { 4 };
            for _ in 0..reps {
                let t = Instant::now();
                forward(
                    set,
                    sizes,
                    [rq!(&q), rk!(&k), rk!(&v)],
                    RowsMut { values: &mut o, batch_stride: sizes.num_queries * d, row_stride: d },
                    Some(&mut lse),
                );
                tf.push(t.elapsed().as_secs_f64());
                let t = Instant::now();
                let saved = Saved {
                    query: rq!(&q),
                    key: rk!(&k),
                    value: rk!(&v),
                    output: rq!(&o),
                    log_sum: &lse,
                    grad_output: rq!(&g),
                };
                backward(
                    set,
                    sizes,
                    saved,
                    [
                        RowsMut { values: &mut gq, batch_stride: sizes.num_queries * d, row_stride: d },
                        RowsMut { values: &mut gk, batch_stride: sizes.num_keys * d, row_stride: d },
                        RowsMut { values: &mut gv, batch_stride: sizes.num_keys * d, row_stride: d },
                    ],
                );
                tb.push(t.elapsed().as_secs_f64());
            }
            let med = |v: &mut Vec<f64>| {
                v.sort_by(f64::total_cmp);
                v[v.len() / 2]
            };
            let (f, b) = (med(&mut tf), med(&mut tb));
            let fl = 4.0 * (sizes.batch * sizes.num_queries * sizes.num_keys * d) as f64;
            println!(
                "{name} {}: fwd {:.2} ms {:.0} GF/s, bwd {:.2} ms {:.0} GF/s",
                set.name(),
                f * 1e3,
                fl / f / 1e9,
                b * 1e3,
                fl * 2.5 / b / 1e9
            );
        }
    }
}
