/* The candidate of least cost of RCAMO, with the distance cost.
 *
 * The same computation as RCAMO._near, RCAMO._choose and LeastCost.choose in NumPy, which are the reference and explain
 * the method. A candidate is given up as soon as its cost exceeds that of the best one. */

#include "shapes.h"

#include <math.h>
#include <string.h>

#define TIED 1e-13            /* as in imitarm.policies.least_cost */
#define TOUCHES 1e-6          /* [m] the same */
#define LARGEST_EXPONENT 60.0 /* as in imitarm.policies.obstacle_cost */
#define NO_COST 40.0          /* exp(-40) is nothing */

/* The constants of LeastCost and DistanceCost, with H instants, S spheres, C candidates of d coordinates, R speeds of
 * the phase, and m one-sided directions; arrays by these numbers, as in Python. */
typedef struct {
    int64_t H, S, C, d, R, m;
    const double *times, *A, *B, *gains, *weights, *task, *pull, *candidates, *one_sided, *rates, *waiting;
    const double *radii, *spheres;
    double curvature, change_weight, weight, limit, clearance, width, influence, reach, largest_a, largest_b, rate_time, beta, cap;
    double growth, growth_cap, lever;
} LeastCost;

/* The motion at n + 1 phases; rotations: of the tool at each of them, or one for all, or none (n_rotations). */
typedef struct {
    int64_t n, n_rotations;
    const double *positions, *precision, *rotations, *goal;
    double duration, speed;
} Path;

/* What holds in one step; spring: acceleration of spring and damper / a_max; axes: the frame of the motion (3, d). */
typedef struct {
    double x[3], lag[3], e[3], v[3], previous[3], spring[3], phase, rate, elapsed, axes[9];
} State;

/* Memory for one step, for n obstacles near. */
typedef struct {
    Solid *solids;           /* (n, H) */
    int64_t *obstacles;      /* (n) index in the scene */
    double *free, *scaled, *smooth;
    int64_t *order;          /* of the candidates, by smooth */
    double *centers, *gaps, *reduction, *costs;
    int64_t *arrived, *near;
    double *margins; /* (n, H) */
} Memory;

static int64_t words(int64_t bytes) { return (bytes + 7) / 8; }

/* The next part of scratch, after `used` doubles; null if scratch is null, which only counts. */
static void *part(double *scratch, int64_t *used, int64_t n)
{
    int64_t begin = *used;
    *used += n;
    return scratch ? scratch + begin : 0;
}

static int64_t lay_out(Memory *memory, const LeastCost *c, int64_t n, double *scratch)
{
    int64_t used = 0;
    memory->solids = part(scratch, &used, words((int64_t)sizeof(Solid) * n * c->H));
    memory->obstacles = part(scratch, &used, n);
    memory->free = part(scratch, &used, 3 * c->H);
    memory->scaled = part(scratch, &used, 3 * c->C);
    memory->smooth = part(scratch, &used, c->C);
    memory->order = part(scratch, &used, c->C);
    memory->centers = part(scratch, &used, 3 * c->R * c->H * c->S);
    memory->gaps = part(scratch, &used, c->R * n * c->H * c->S);
    memory->reduction = part(scratch, &used, c->R * n * c->H);
    memory->costs = part(scratch, &used, c->R * c->C);
    memory->arrived = part(scratch, &used, c->R * c->H);
    memory->near = part(scratch, &used, c->R * n * c->H * c->S);
    memory->margins = part(scratch, &used, n * c->H);
    return used;
}

/* Number of doubles that a step with n obstacles needs as scratch. */
int64_t least_cost_scratch(const LeastCost *c, int64_t n)
{
    Memory memory;
    return lay_out(&memory, c, n, 0);
}

static double dot(const double *a, const double *b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

static double at_most_one(double x) { return x < 0.0 ? 0.0 : x > 1.0 ? 1.0 : x; }

static double cost_at(const LeastCost *c, double gap)
{
    double exponent = (c->clearance - gap) / c->width;
    return exponent < -NO_COST ? 0.0 : exp(exponent < LARGEST_EXPONENT ? exponent : LARGEST_EXPONENT);
}

/* The largest eigenvalue of a symmetric matrix (3, 3). */
static double largest_eigenvalue(const double *a)
{
    double mean = (a[0] + a[4] + a[8]) / 3.0, x = a[0] - mean, y = a[4] - mean, z = a[8] - mean;
    double spread = x * x + y * y + z * z + 2.0 * (a[1] * a[1] + a[2] * a[2] + a[5] * a[5]);
    double p = sqrt(spread / 6.0);
    if (!(p > 0.0))
        return mean;
    double determinant = x * (y * z - a[5] * a[5]) - a[1] * (a[1] * z - a[5] * a[2]) + a[2] * (a[1] * a[5] - y * a[2]);
    double cosine = determinant / (2.0 * p * p * p);
    return mean + 2.0 * p * cos(acos(cosine < -1.0 ? -1.0 : cosine > 1.0 ? 1.0 : cosine) / 3.0);
}

/* The margins by the estimates of the obstacles, as RCAMO.estimated_margins; null if all are exact. */
static const double *margins_of(Memory *memory, const Obstacles *obstacles, const LeastCost *c, double elapsed)
{
    int exact = 1;
    for (int64_t i = 0; i < 9 * obstacles->n; i++)
        exact = exact && obstacles->covariances[i] == 0.0;
    for (int64_t i = 0; i < obstacles->n && !exact; i++) {
        const double *v = obstacles->velocities + 3 * i, *omega = obstacles->rates + 3 * i;
        double sigma = sqrt(fmax(largest_eigenvalue(obstacles->covariances + 9 * i), 0.0));
        double speed = sqrt(dot(v, v)) + sqrt(dot(omega, omega)) * fmin(obstacles->radii[i], c->lever);
        speed = sigma > 0.0 ? c->growth * speed : 0.0;
        for (int64_t m = 0; m < c->H; m++) {
            double grown = fmin(speed * (elapsed + c->times[m]), c->growth_cap);
            memory->margins[c->H * i + m] = fmin(c->beta * sigma, c->cap) + grown;
        }
    }
    return exact ? 0 : memory->margins;
}

/* Find the obstacles that may have an effect within the horizon; returns their number. */
static int64_t find_near(Memory *memory, const Obstacles *obstacles, double dt, const LeastCost *c, const Path *path,
                         const State *s, const double *margins)
{
    int64_t n = 0;
    double last = c->times[c->H - 1];
    double travel = c->largest_a * sqrt(dot(s->e, s->e)) + c->largest_b * sqrt(dot(s->v, s->v)) + path->speed * last;
    for (int64_t i = 0; i < obstacles->n; i++) {
        const double *v = obstacles->velocities + 3 * i;
        double margin = margins ? margins[c->H * i] : 0.0;
        for (int64_t m = 1; margins && m < c->H; m++)
            margin = fmax(margin, margins[c->H * i + m]);
        Solid *solid = memory->solids + n * c->H;
        place(solid, obstacles, i, dt + s->elapsed);
        double offset[3] = {solid->center[0] - s->x[0], solid->center[1] - s->x[1], solid->center[2] - s->x[2]};
        double gap = isinf(solid->radius) ? signed_distance(solid, s->x, 0) : sqrt(dot(offset, offset)) - solid->radius;
        if (gap - last * sqrt(dot(v, v)) > c->reach + travel + margin)
            continue;
        for (int64_t m = 0; m < c->H; m++)
            place(solid + m, obstacles, i, dt + s->elapsed + c->times[m]);
        memory->obstacles[n++] = i;
    }
    return n;
}

/* The candidates (C, 3) in the base frame, so that u less the acceleration of spring and damper keeps the limit. */
static void place_candidates(double *scaled, const LeastCost *c, const State *s)
{
    int changed = 0;
    for (int64_t i = 0; i < c->C; i++) {
        double *u = scaled + 3 * i, change[3];
        for (int k = 0; k < 3; k++) {
            u[k] = 0.0;
            for (int64_t a = 0; a < c->d; a++)
                u[k] += c->candidates[c->d * i + a] * s->axes[c->d * k + a];
            change[k] = u[k] - s->spring[k];
        }
        double factor = c->limit / sqrt(fmax(dot(change, change), 1e-12));
        if (i == 0 || factor >= 1.0)
            continue;
        changed = 1;
        for (int k = 0; k < 3; k++)
            u[k] = s->spring[k] + factor * change[k];
    }
    for (int64_t i = 0; i < c->C && changed; i++) {
        double *u = scaled + 3 * i, length = fmax(sqrt(dot(u, u)), 1.0);
        for (int k = 0; k < 3; k++)
            u[k] /= length;
    }
}

/* The candidates in the base frame without those that are not allowed, and their costs without obstacles, in order. */
static int64_t prepare(Memory *memory, const LeastCost *c, const Path *path, const State *s)
{
    const double *theta = path->precision + 9 * (int64_t)rint(s->phase * (double)path->n);
    double constant = 0.0, slope[3] = {0.0, 0.0, 0.0};
    int64_t kept = 0;
    for (int64_t m = 0; m < c->H; m++) {
        double *free = memory->free + 3 * m, pulled[3];
        for (int k = 0; k < 3; k++)
            free[k] = c->A[m] * s->e[k] + c->B[m] * s->v[k] + c->A[m] * s->lag[k];
        for (int k = 0; k < 3; k++)
            pulled[k] = free[0] * theta[k] + free[1] * theta[3 + k] + free[2] * theta[6 + k];
        constant += c->task[m] * dot(pulled, free);
        for (int k = 0; k < 3; k++)
            slope[k] += c->pull[m] * pulled[k];
    }
    constant = 0.5 * constant + c->change_weight * dot(s->previous, s->previous);
    for (int k = 0; k < 3; k++)
        slope[k] -= 2.0 * c->change_weight * s->previous[k];
    place_candidates(memory->scaled, c, s);
    for (int64_t i = 0; i < c->C; i++) {
        double *u = memory->scaled + 3 * kept, bent[3];
        int allowed = 1;
        memmove(u, memory->scaled + 3 * i, 3 * sizeof *u);
        for (int64_t a = 0; a < c->m; a++)
            allowed = allowed && dot(u, c->one_sided + 3 * a) <= 1e-9;
        if (!allowed)
            continue;
        for (int k = 0; k < 3; k++)
            bent[k] = u[0] * theta[k] + u[1] * theta[3 + k] + u[2] * theta[6 + k];
        memory->smooth[kept] = dot(u, slope) + 0.5 * c->curvature * dot(bent, u) + (c->weight * dot(u, u) + constant);
        int64_t at = kept++;
        for (; at > 0 && memory->smooth[memory->order[at - 1]] > memory->smooth[kept - 1]; at--)
            memory->order[at] = memory->order[at - 1];
        memory->order[at] = kept - 1;
    }
    return kept;
}

/* The centre of a sphere of the tool, whose tip is at a sample of the path. */
static void place_sphere(double *center, const double *tip, const double *sphere, const Path *path, int64_t sample)
{
    const double *R = path->n_rotations ? path->rotations + 9 * (path->n_rotations > 1 ? sample : 0) : 0;
    for (int r = 0; r < 3; r++)
        center[r] = tip[r] + (R ? dot(R + 3 * r, sphere) : 0.0);
}

/* The motion without coupling at one speed of the phase: centres of the spheres (H, S), and whether it has arrived. */
static void predict(Memory *memory, const LeastCost *c, const Path *path, const State *s, int64_t rate)
{
    for (int64_t m = 0; m < c->H; m++) {
        double t = c->times[m], transient = c->rate_time / path->duration * (1.0 - exp(t / -c->rate_time));
        double phase = s->phase + c->rates[rate] * (t / path->duration) + (s->rate - c->rates[rate]) * transient;
        double x = at_most_one(phase) * (double)path->n, tip[3];
        int64_t i = (int64_t)x < path->n - 1 ? (int64_t)x : path->n - 1;
        const double *p = path->positions + 3 * i;
        for (int k = 0; k < 3; k++)
            tip[k] = p[k] + (x - (double)i) * (p[3 + k] - p[k]) + memory->free[3 * m + k];
        double *centers = memory->centers + 3 * c->S * (c->H * rate + m);
        for (int64_t k = 0; k < c->S; k++)
            place_sphere(centers + 3 * k, tip, c->spheres + 3 * k, path, (int64_t)rint(x));
        memory->arrived[c->H * rate + m] = phase >= 1.0;
    }
}

/* By how much the costs (n, H) of obstacles are reduced after the arrival, at one speed of the phase. */
static void reduce(Memory *memory, const LeastCost *c, const Path *path, const double *margins, int64_t n, int64_t rate)
{
    for (int64_t i = 0; i < n; i++)
        for (int64_t m = 0; m < c->H; m++) {
            double *reduction = memory->reduction + (n * rate + i) * c->H + m, least = INFINITY, most = 0.0, center[3];
            *reduction = 0.0;
            if (!memory->arrived[c->H * rate + m])
                continue;
            for (int64_t k = 0; k < c->S; k++) {
                place_sphere(center, path->goal, c->spheres + 3 * k, path, path->n);
                double gap = signed_distance(memory->solids + i * c->H + m, center, 0) - c->radii[k];
                gap -= margins ? margins[c->H * memory->obstacles[i] + m] : 0.0;
                least = fmin(least, gap);
                most = fmax(most, cost_at(c, gap));
            }
            *reduction = least >= c->clearance - TOUCHES ? most : 0.0;
        }
}

/* Distances without coupling (n, H, S) at one speed of the phase, which pairs are near, and the cost without coupling. */
static double without_coupling(Memory *memory, const LeastCost *c, const double *margins, int64_t n, int64_t rate)
{
    double cost = 0.0;
    for (int64_t i = 0; i < n; i++) {
        for (int64_t m = 0; m < c->H; m++) {
            int64_t at = (n * rate + i) * c->H + m;
            double *gaps = memory->gaps + c->S * at, most = 0.0, least = INFINITY, gain = c->gains[m];
            const double *centers = memory->centers + 3 * c->S * (c->H * rate + m);
            for (int64_t k = 0; k < c->S; k++) {
                gaps[k] = signed_distance(memory->solids + i * c->H + m, centers + 3 * k, 0);
                gaps[k] -= c->radii[k] + (margins ? margins[c->H * memory->obstacles[i] + m] : 0.0);
                least = fmin(least, gaps[k]);
                most = fmax(most, cost_at(c, gaps[k]));
            }
            for (int64_t k = 0; k < c->S; k++)
                memory->near[c->S * at + k] = gaps[k] - gain <= c->influence && gaps[k] <= least + 2.0 * gain;
            cost += c->weights[m] * fmax(most - memory->reduction[at], 0.0);
        }
    }
    return cost;
}

/* Cost of obstacles for a candidate u at one speed of the phase; given up once it exceeds `most`. With nearest, the
 * obstacle that comes nearest and its distance are set instead. */
static double with_coupling(const Memory *memory, const LeastCost *c, const double *margins, int64_t n, int64_t rate,
                            const double *u, double most, int64_t *nearest, double *gap)
{
    double cost = 0.0;
    for (int64_t i = 0; i < n; i++)
        for (int64_t m = 0; m < c->H; m++) {
            int64_t at = (n * rate + i) * c->H + m;
            const double *centers = memory->centers + 3 * c->S * (c->H * rate + m);
            double largest = 0.0;
            for (int64_t k = 0; k < c->S; k++) {
                if (!memory->near[c->S * at + k])
                    continue;
                double point[3] = {centers[3 * k] + c->gains[m] * u[0], centers[3 * k + 1] + c->gains[m] * u[1],
                                   centers[3 * k + 2] + c->gains[m] * u[2]};
                double distance = signed_distance(memory->solids + i * c->H + m, point, 0);
                distance -= c->radii[k] + (margins ? margins[c->H * memory->obstacles[i] + m] : 0.0);
                if (nearest && distance < *gap) {
                    *gap = distance;
                    *nearest = memory->obstacles[i];
                }
                largest = nearest ? 0.0 : fmax(largest, cost_at(c, distance));
            }
            cost += c->weights[m] * fmax(largest - memory->reduction[at], 0.0);
            if (cost > most)
                return cost;
        }
    return cost;
}

static double tie(double least) { return least + TIED * fmax(1.0, fabs(least)); }

typedef struct {
    int64_t rate, candidate;
    double cost;
} Best;

/* The best candidate at the speeds begin to end; its cost is above bound if there is none better. */
static Best best_of(Memory *memory, const LeastCost *c, const double *margins, int64_t n, int64_t n_candidates,
                    int64_t begin, int64_t end, double bound)
{
    Best best = {begin, 0, INFINITY};
    double least = bound, *costs = memory->costs;
    for (int64_t r = begin; r < end; r++) {
        costs[c->C * r] = memory->smooth[0] + c->waiting[r] + without_coupling(memory, c, margins, n, r);
        least = fmin(least, costs[c->C * r]);
    }
    for (int64_t at = 0; at < n_candidates; at++) {
        int64_t i = memory->order[at];
        for (int64_t r = begin; r < end && i > 0; r++) {
            double most = tie(least), smooth = memory->smooth[i] + c->waiting[r];
            costs[c->C * r + i] = smooth;
            if (smooth <= most)
                costs[c->C * r + i] += with_coupling(memory, c, margins, n, r, memory->scaled + 3 * i, most - smooth, 0, 0);
            least = fmin(least, costs[c->C * r + i]);
        }
    }
    double most = -INFINITY, lowest = INFINITY;
    for (int64_t r = begin; r < end; r++)
        for (int64_t i = 0; i < n_candidates; i++)
            lowest = fmin(lowest, costs[c->C * r + i]);
    for (int64_t r = begin; r < end; r++) /* of equal ones, that which leads highest, then the first one */
        for (int64_t i = 0; i < n_candidates; i++)
            if (costs[c->C * r + i] <= tie(lowest))
                most = fmax(most, memory->scaled[3 * i + 2]);
    for (int64_t r = begin; r < end; r++)
        for (int64_t i = 0; i < n_candidates; i++)
            if (costs[c->C * r + i] <= tie(lowest) && memory->scaled[3 * i + 2] >= most - TIED) {
                best.rate = r, best.candidate = i, best.cost = costs[c->C * r + i];
                return best;
            }
    return best;
}

/* The obstacle that comes nearest with a candidate, and its distance. */
static int64_t nearest_with(const Memory *memory, const LeastCost *c, const double *margins, int64_t n, const Best *best,
                            double *gap)
{
    int64_t nearest = -1;
    *gap = INFINITY;
    if (best->candidate)
        with_coupling(memory, c, margins, n, best->rate, memory->scaled + 3 * best->candidate, INFINITY, &nearest, gap);
    for (int64_t k = 0, found = nearest >= 0; k < n * c->H * c->S && !found; k++) { /* without coupling */
        double own = memory->gaps[best->rate * n * c->H * c->S + k];
        if (own < *gap) {
            *gap = own;
            nearest = memory->obstacles[k / (c->H * c->S)];
        }
    }
    return nearest;
}

/* Choose; margins (n_obstacles, H), or null for those by the uncertainty of the obstacles' positions. Out: u / a_max (3), speed of the phase, cost, distance of the nearest
 * obstacle. Returns the nearest obstacle, or -1 if none is near: then nothing was chosen. */
int64_t least_cost_choice(const Obstacles *obstacles, double dt, const LeastCost *c, const Path *path, const State *s,
                          const double *margins, double *scratch, double *out)
{
    Memory memory;
    Best best = {0, 0, INFINITY};
    lay_out(&memory, c, obstacles->n, scratch);
    margins = margins ? margins : margins_of(&memory, obstacles, c, s->elapsed);
    int64_t n = find_near(&memory, obstacles, dt, c, path, s, margins);
    if (!n)
        return -1;
    int64_t n_candidates = prepare(&memory, c, path, s), begin = 0;
    double least = memory.smooth[memory.order[0]];
    for (int64_t end = 1; begin < c->R; begin = end, end = c->R) { /* the learned speed first, then all others */
        double waiting = INFINITY;
        for (int64_t r = begin; r < end; r++)
            waiting = fmin(waiting, c->waiting[r]);
        if (least + waiting > best.cost)
            break;
        for (int64_t r = begin; r < end; r++) {
            predict(&memory, c, path, s, r);
            reduce(&memory, c, path, margins, n, r);
        }
        Best found = best_of(&memory, c, margins, n, n_candidates, begin, end, best.cost);
        if (found.cost < best.cost - TIED)
            best = found;
    }
    memcpy(out, memory.scaled + 3 * best.candidate, 3 * sizeof *out);
    out[3] = c->rates[best.rate];
    out[4] = best.cost;
    return nearest_with(&memory, c, margins, n, &best, out + 5);
}
