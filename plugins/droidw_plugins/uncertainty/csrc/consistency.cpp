// The costly parts of the consistency objective on a CPU; plain C interface, through ctypes.
// The torch code in `_objective.py` is the reference. Sums have a fixed order, so that the same
// input gives the same bytes with any number of threads.

#include <cmath>
#include <cstdint>

namespace {

constexpr int LANES = 16;  // partial sums, so that the compiler can use vectors without reordering

float add_up(const float* lanes) {
    float total = 0;
    for (int k = 0; k < LANES; ++k) total += lanes[k];
    return total;
}

}  // namespace

extern "C" {

int32_t dw_consistency_version() { return 1; }

// Where the cells of frames source [edges] fall in frames goal [edges], rows of the stacks that
// `first` counts in. disps [*,cells] with rows depth [edges]; turn [edges,9] and shift [edges,3] take
// (x, y, 1) and the disparity to (x Z, y Z, Z). place [edges,2,cells] is moved to the border where it
// lies outside; inside [edges,cells] says so.
void dw_samples(int64_t edges, int64_t height, int64_t width, const float* turn, const float* shift,
                const float* disps, const int64_t* depth, const int64_t* goal, float near,
                int32_t threads, float* place, int64_t* first, float* weights, uint8_t* inside) {
    const int64_t cells = height * width, pairs = edges * cells;
    const float right = float(width - 1), bottom = float(height - 1);
    const int32_t last_left = width > 1 ? int32_t(width) - 2 : 0;
    const int32_t last_top = height > 1 ? int32_t(height) - 2 : 0;
#pragma omp parallel for schedule(static) num_threads(threads) if (threads > 1)
    for (int64_t e = 0; e < edges; ++e) {
        const float* R = turn + 9 * e;
        const float* t = shift + 3 * e;
        const float* z = disps + depth[e] * cells;
        float* place_x = place + 2 * e * cells;
        float* place_y = place_x + cells;
        const int64_t base = goal[e] * cells;
        for (int64_t row = 0; row < height; ++row) {
            const float v = float(row);
            const int64_t start = row * width;
            for (int64_t column = 0; column < width; ++column) {
                const int64_t p = start + column, n = e * cells + p;
                const float u = float(column);
                const float Z = R[6] * u + R[7] * v + R[8] + t[2] * z[p];
                const float scale = 1.0f / (Z >= near ? Z : near);
                const float x = (R[0] * u + R[1] * v + R[2] + t[0] * z[p]) * scale;
                const float y = (R[3] * u + R[4] * v + R[5] + t[1] * z[p]) * scale;
                inside[n] = Z >= near && x >= 0 && x <= right && y >= 0 && y <= bottom;
                // Comparisons with NaN are false, which leaves 0.
                const float px = x >= 0 ? (x <= right ? x : right) : 0;
                const float py = y >= 0 ? (y <= bottom ? y : bottom) : 0;
                // The last row and column are reached with weight 1 from the one before.
                const int32_t left = int32_t(px) < last_left ? int32_t(px) : last_left;
                const int32_t top = int32_t(py) < last_top ? int32_t(py) : last_top;
                const float a = px - float(left), b = py - float(top), ab = a * b;
                place_x[p] = px;
                place_y[p] = py;
                first[n] = base + top * int32_t(width) + left;
                weights[n] = 1.0f - a - (b - ab);
                weights[pairs + n] = a - ab;
                weights[2 * pairs + n] = b - ab;
                weights[3 * pairs + n] = ab;
            }
        }
    }
}

// Cosine [edges,cells] of the feature of a cell and the bilinear mean of four features.
// rows [frames*cells,channels], lengths [frames*cells], source [edges] frame of the cells,
// first [edges*cells] row of the first neighbour, steps [4] from there to each of the four,
// weights [4,edges*cells]. Cells that are not inside [edges*cells] get 0.
void dw_similarity(int64_t edges, int64_t cells, int64_t channels, const float* rows,
                   const float* lengths, const int64_t* source, const int64_t* first,
                   const int64_t* steps, const float* weights, const uint8_t* inside,
                   float epsilon, int32_t threads, float* cosine) {
    const int64_t pairs = edges * cells;
    const int64_t whole = channels / LANES * LANES;
#pragma omp parallel for schedule(static) num_threads(threads) if (threads > 1)
    for (int64_t e = 0; e < edges; ++e) {
        for (int64_t p = 0; p < cells; ++p) {
            const int64_t n = e * cells + p;
            if (!inside[n]) {
                cosine[n] = 0;
                continue;
            }
            const int64_t at = source[e] * cells + p;
            const float* here = rows + at * channels;
            const float* a = rows + (first[n] + steps[0]) * channels;
            const float* b = rows + (first[n] + steps[1]) * channels;
            const float* c = rows + (first[n] + steps[2]) * channels;
            const float* d = rows + (first[n] + steps[3]) * channels;
            const float wa = weights[n], wb = weights[pairs + n];
            const float wc = weights[2 * pairs + n], wd = weights[3 * pairs + n];
            float dot[LANES] = {}, square[LANES] = {};
            for (int64_t k = 0; k < whole; k += LANES) {
                for (int l = 0; l < LANES; ++l) {
                    const float there =
                        wa * a[k + l] + wb * b[k + l] + wc * c[k + l] + wd * d[k + l];
                    dot[l] += there * here[k + l];
                    square[l] += there * there;
                }
            }
            for (int64_t k = whole; k < channels; ++k) {
                const float there = wa * a[k] + wb * b[k] + wc * c[k] + wd * d[k];
                dot[k - whole] += there * here[k];
                square[k - whole] += there * there;
            }
            cosine[n] = add_up(dot) / (lengths[at] * std::sqrt(add_up(square)) + epsilon);
        }
    }
}

// Gradient [frames*cells] of the decoupled pair energy sum of rho / (u_i u_ij) with respect to u
// [frames*cells], added to `gradient`; returns the energy. Pairs of residual 0 are passed over.
double dw_pair_gradient(int64_t edges, int64_t cells, const float* u, const float* rho,
                        const int64_t* source, const int64_t* first, const int64_t* steps,
                        const float* weights, float* gradient) {
    const int64_t pairs = edges * cells;
    double total = 0;
    for (int64_t e = 0; e < edges; ++e) {
        float* own = gradient + source[e] * cells;
        const float* here = u + source[e] * cells;
        double sum = 0;
        for (int64_t p = 0; p < cells; ++p) {
            const int64_t n = e * cells + p;
            if (rho[n] == 0.0f) continue;
            float there = 0;
            for (int k = 0; k < 4; ++k) there += weights[k * pairs + n] * u[first[n] + steps[k]];
            const float energy = rho[n] / (here[p] * there);
            sum += energy;
            own[p] -= energy / here[p];
            const float share = energy / there;
            for (int k = 0; k < 4; ++k) {
                gradient[first[n] + steps[k]] -= weights[k * pairs + n] * share;
            }
        }
        total += sum;
    }
    return total;
}

}  // extern "C"
