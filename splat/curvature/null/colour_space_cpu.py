"""Projection of SH coefficients onto a `ColourSpace` on the CPU: one pass over the Gaussians."""

from splat.backend.cpu.jit import kernel


@kernel
def project_colours(start, stop, basis, rank, row, slopes, slope_rank, x, out):
    """Write P x of Gaussians start .. stop to out.

    x, out (n, b, 3 k): coefficients of k vectors, those of a channel side by side.  basis (m, r, b), rank (m,): spaces of
    harmonics; row (n, 3): the space of each channel.  slopes (n, s, b, 3), slope_rank (n,).  A channel whose space is complete
    is copied bit for bit.
    """
    bands, vectors = x.shape[1], x.shape[2] // 3
    for i in range(start, stop):
        for c in range(3):
            j = row[i, c]
            for k in range(c * vectors, (c + 1) * vectors):
                whole = rank[j] == bands
                for b in range(bands):
                    out[i, b, k] = x[i, b, k] if whole else 0
                for r in range(0 if whole else rank[j]):
                    along = x.dtype.type(0)
                    for b in range(bands):
                        along += basis[j, r, b] * x[i, b, k]
                    for b in range(bands):
                        out[i, b, k] += basis[j, r, b] * along
        for s in range(slope_rank[i]):
            for k in range(vectors):
                along = x.dtype.type(0)
                for b in range(bands):
                    for c in range(3):
                        along += slopes[i, s, b, c] * x[i, b, c * vectors + k]
                for b in range(bands):
                    for c in range(3):
                        out[i, b, c * vectors + k] += slopes[i, s, b, c] * along
