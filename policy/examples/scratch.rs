use std::time::Instant;
use tandem_policy::*;
fn best(name: &str, flop: f64, mut f: impl FnMut()) {
    let mut b = f64::MAX;
    for _ in 0..60 {
        let t = Instant::now();
        for _ in 0..20 {
            f();
        }
        b = b.min(t.elapsed().as_secs_f64() / 20.0);
    }
    println!("{name:28} {:8.1} us {:6.1} GFLOP/s", b * 1e6, flop / b / 1e9);
}
fn main() {
    {
        let layout = tandem_core::Layout::new(tandem_core::Task::Push, 2);
        let shape = MlpShape::critic(layout, 256, 4, 2);
        let params =
            shape.initialise(&mut tandem_core::episode_rng(0, 0, tandem_core::Stream::Reset));
        let mut ws = Workspace::new(&shape, 256);
        let x = vec![0.3f32; 256 * 68];
        let mut o = vec![0.0f32; 512];
        let d = vec![0.01f32; 512];
        let mut g = vec![0.0f32; shape.n_parameters()];
        let mut dx = vec![0.0f32; 256 * 6];
        let mac = 2.0 * 256.0 * (68. * 256. + 3. * 65536. + 512.);
        best("forward critic", mac, || {
            forward(
                &shape,
                &params,
                Matrix::new(&x, 256, 68),
                &mut ws,
                &mut MatrixMut::new(&mut o, 256, 2),
            )
        });
        best("backward parameters", 2.0 * mac - 2.0 * 256. * 68. * 256., || {
            backward_parameters(&shape, &params, Matrix::new(&x, 256, 68), &mut ws, &d, &mut g)
        });
        best("backward input", mac - 2.0 * 256. * 62. * 256., || {
            backward_input(&shape, &params, &mut ws, &d, 62..68, &mut dx)
        });
    }

    let a = vec![0.5f32; 256 * 256];
    let w = vec![0.25f32; 256 * 256];
    let mut c = vec![0.0f32; 256 * 256];
    let f = 2.0 * 256f64.powi(3);
    fn m(d: &[f32], r: usize, c: usize) -> Matrix<'_> {
        Matrix::new(d, r, c)
    }
    best("nn", f, || {
        multiply(&mut MatrixMut::new(&mut c, 256, 256), m(&a, 256, 256), m(&w, 256, 256))
    });
    best("forward W^T", f, || {
        multiply(
            &mut MatrixMut::new(&mut c, 256, 256),
            m(&a, 256, 256),
            m(&w, 256, 256).transposed(),
        )
    });
    best("dW = d^T x", f, || {
        multiply(
            &mut MatrixMut::new(&mut c, 256, 256),
            m(&a, 256, 256).transposed(),
            m(&w, 256, 256),
        )
    });
    best("t t", f, || {
        multiply(
            &mut MatrixMut::new(&mut c, 256, 256),
            m(&a, 256, 256).transposed(),
            m(&w, 256, 256).transposed(),
        )
    });
    let x = vec![0.5f32; 256 * 68];
    let w0 = vec![0.5f32; 256 * 68];
    let mut g0 = vec![0.0f32; 256 * 68];
    best("fwd k=68", f * 68. / 256., || {
        multiply(
            &mut MatrixMut::new(&mut c, 256, 256),
            m(&x, 256, 68),
            m(&w0, 256, 68).transposed(),
        )
    });
    best("fwd k=68 nn", f * 68. / 256., || {
        multiply(&mut MatrixMut::new(&mut c, 256, 256), m(&x, 256, 68), m(&w0, 68, 256))
    });
    best("dW n=68", f * 68. / 256., || {
        multiply(
            &mut MatrixMut::new(&mut g0, 256, 68),
            m(&a, 256, 256).transposed(),
            m(&x, 256, 68),
        )
    });
    best("dX 6 cols", f * 6. / 256., || {
        multiply(
            &mut MatrixMut::new(&mut c, 256, 6),
            m(&a, 256, 256),
            Matrix::with_stride(&w0[62..], 256, 6, 68),
        )
    });
    for n in [1usize, 2, 6] {
        let mut o = vec![0.0f32; 256 * n];
        let wl = vec![0.5f32; 256 * n];
        best(&format!("last fwd nn {n}"), f * n as f64 / 256., || {
            multiply(&mut MatrixMut::new(&mut o, 256, n), m(&a, 256, 256), m(&wl, 256, n))
        });
        let wl = vec![0.5f32; 256 * n];
        let mut o = vec![0.0f32; 256 * n];
        let fl = f * n as f64 / 256.;
        best(&format!("last fwd {n}"), fl, || {
            multiply(
                &mut MatrixMut::new(&mut o, 256, n),
                m(&a, 256, 256),
                m(&wl, n, 256).transposed(),
            )
        });
        best(&format!("last dW {n}"), fl, || {
            multiply(
                &mut MatrixMut::new(&mut c, n, 256),
                m(&wl, 256, n).transposed(),
                m(&a, 256, 256),
            )
        });
        best(&format!("last dX {n}"), fl, || {
            multiply(&mut MatrixMut::new(&mut c, 256, 256), m(&a, 256, n), m(&wl, n, 256))
        });
    }
    let mut p = vec![0.5f32; 215000];
    let g = vec![0.1f32; 215000];
    let mut ad = Adam::new(215000, 1e-3);
    best("adam", 0., || ad.step(&mut p, &g));
    let mut t = p.clone();
    best("polyak", 0., || polyak_update(&mut t, &p, 0.95));
    best("finite", 0., || {
        std::hint::black_box(all_finite(&p));
    });
    best("tanh 1536", 0., || {
        let mut s = 0.0;
        for i in 0..1536 {
            s += tanh(std::hint::black_box(i as f32 / 700.0));
        }
        std::hint::black_box(s);
    });
    let src = vec![0.5f32; 256 * 256];
    let mut dst = vec![0.0f32; 256 * 256];
    best("transpose naive", 0., || {
        for (i, row) in src.chunks_exact(256).enumerate() {
            for (j, x) in row.iter().enumerate() {
                dst[j * 256 + i] = *x;
            }
        }
        std::hint::black_box(&mut dst);
    });
    best("transpose 16", 0., || {
        tr::<16>(&src, &mut dst, 256, 256);
        std::hint::black_box(&mut dst);
    });
    best("transpose 8", 0., || {
        tr::<8>(&src, &mut dst, 256, 256);
        std::hint::black_box(&mut dst);
    });
    let mut v = vec![0.5f32; 65536];
    let bias = vec![0.1f32; 256];
    let _ = (&mut v, &bias);
    best("transpose swapped order", 0., || {
        tr2(&src, &mut dst, 256, 256);
        std::hint::black_box(&mut dst);
    });
    best("transpose no dispatch", 0., || {
        tr3(&src, &mut dst, 256, 256);
        std::hint::black_box(&mut dst);
    });
    best("transpose 4x16", 0., || {
        tr4(&src, &mut dst, 256, 256);
        std::hint::black_box(&mut dst);
    });
    for (n, inp) in [(1, 28), (2, 28), (4, 28), (32, 28)] {
        let layout = tandem_core::Layout::new(tandem_core::Task::Push, 2);
        let _ = inp;
        let shape = MlpShape::actor(layout, 256, 4);
        let params =
            shape.initialise(&mut tandem_core::episode_rng(0, 0, tandem_core::Stream::Reset));
        let mut actor = Actor::new(
            layout,
            tandem_core::work::PublishedActor {
                version: 0,
                n_hidden: 256,
                n_hidden_layers: 4,
                actor: params,
                observation_mean: vec![0.0; 56],
                observation_std: vec![1.0; 56],
                goal_mean: vec![0.0; 6],
                goal_std: vec![1.0; 6],
            },
        )
        .unwrap();
        let o = vec![0.1f32; 56 * n];
        let g = vec![0.1f32; 6 * n];
        let mut ac = vec![0.0f32; 6 * n];
        best(&format!("act {n}"), 2.0 * 215560.0 * n as f64, || actor.act(&o, &g, &mut ac));
    }
}

fn tr<const T: usize>(src: &[f32], dst: &mut [f32], r: usize, c: usize) {
    pulp::Arch::new().dispatch(|| {
        for i0 in (0..r).step_by(T) {
            for j0 in (0..c).step_by(T) {
                let mut t = [[0.0f32; T]; T];
                for i in 0..T {
                    let row: &[f32; T] = src[(i0 + i) * c + j0..][..T].try_into().unwrap();
                    for j in 0..T {
                        t[j][i] = row[j];
                    }
                }
                for j in 0..T {
                    dst[(j0 + j) * r + i0..][..T].copy_from_slice(&t[j]);
                }
            }
        }
    });
}

fn tr2(src: &[f32], dst: &mut [f32], r: usize, c: usize) {
    const T: usize = 16;
    pulp::Arch::new().dispatch(|| {
        for j0 in (0..c).step_by(T) {
            for i0 in (0..r).step_by(T) {
                let mut t = [[0.0f32; T]; T];
                for i in 0..T {
                    let row: &[f32; T] = src[(i0 + i) * c + j0..][..T].try_into().unwrap();
                    for j in 0..T {
                        t[j][i] = row[j];
                    }
                }
                for j in 0..T {
                    dst[(j0 + j) * r + i0..][..T].copy_from_slice(&t[j]);
                }
            }
        }
    });
}
fn tr3(src: &[f32], dst: &mut [f32], r: usize, c: usize) {
    const T: usize = 8;
    for j0 in (0..c).step_by(T) {
        for i0 in (0..r).step_by(T) {
            let mut t = [[0.0f32; T]; T];
            for i in 0..T {
                let row: &[f32; T] = src[(i0 + i) * c + j0..][..T].try_into().unwrap();
                for j in 0..T {
                    t[j][i] = row[j];
                }
            }
            for j in 0..T {
                dst[(j0 + j) * r + i0..][..T].copy_from_slice(&t[j]);
            }
        }
    }
}
fn tr4(src: &[f32], dst: &mut [f32], r: usize, c: usize) {
    const T: usize = 4;
    for i0 in (0..r).step_by(T) {
        for j0 in (0..c).step_by(T) {
            let rows: [&[f32; T]; T] =
                std::array::from_fn(|i| src[(i0 + i) * c + j0..][..T].try_into().unwrap());
            for j in 0..T {
                let col: [f32; T] = std::array::from_fn(|i| rows[i][j]);
                dst[(j0 + j) * r + i0..][..T].copy_from_slice(&col);
            }
        }
    }
}
