/* One update of all tracks, for the usual case: one model of motion, and no doubt about the assignment. And all tracks,
 * predicted to another time.
 *
 * The same computation as MotionFilter.predict, assign, MotionFilter.update and ObstacleTracker._seen, which are the
 * reference. */

#include "shapes.h"

#include <math.h>
#include <string.h>

#define MAX_STATE 9
#define ROW 19         /* position (3), covariance (9), size (3), quaternion (4) */
#define FULL_COUNT 10  /* as in imitarm.perception.tracks */
#define UNCONFIRMED -1 /* the same */
#define ALL_SEEN 1     /* every track is confirmed and has one of the detections, and no detection is left */
#define IN_ORDER 2     /* and detection i belongs to track i */

/* n tracks in one block of memory, as imitarm.perception.track_memory lays them out. */
typedef struct {
    double *x, *P, *sizes, *quaternions, *last_seen; /* (n, s), (n, s, s), (n, 3), (n, 4), (n) */
    int64_t *hits, *ages, *counts, *ids;             /* (n) */
    double *distances;                               /* (n) of the assigned detections */
    int64_t *detections, *owners;                    /* (n), (m) */
} Tracks;

static Tracks tracks_at(double *block, int64_t n, int64_t s)
{
    Tracks t;
    t.x = block;
    t.P = t.x + n * s;
    t.sizes = t.P + n * s * s;
    t.quaternions = t.sizes + 3 * n;
    t.last_seen = t.quaternions + 4 * n;
    t.hits = (int64_t *)(t.last_seen + n);
    t.ages = t.hits + n;
    t.counts = t.ages + n;
    t.ids = t.counts + n;
    t.distances = (double *)(t.ids + n);
    t.detections = (int64_t *)(t.distances + n);
    t.owners = t.detections + n;
    return t;
}

static double trace(const double *matrix, int64_t stride) { return matrix[0] + matrix[stride + 1] + matrix[2 * stride + 2]; }

/* inverse of a 3 x 3 matrix by cofactors */
static void inverse(double *out, const double *m)
{
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++) {
            int a = (j + 1) % 3, b = (j + 2) % 3, c = (i + 1) % 3, d = (i + 2) % 3;
            out[3 * i + j] = m[3 * a + c] * m[3 * b + d] - m[3 * a + d] * m[3 * b + c];
        }
    double determinant = m[0] * out[0] + m[1] * out[3] + m[2] * out[6];
    for (int i = 0; i < 9; i++)
        out[i] /= determinant;
}

/* F x and F P F' + Q, where F has the blocks dt^(j-i) / (j-i)! I */
static void predict(double *x, double *P, double dt, double q, int64_t s)
{
    int64_t order = s / 3 - 1;
    double factor[3] = {1.0, dt, 0.5 * dt * dt}, weight[3] = {1.0, 1.0, 0.5}, powers[6] = {1.0}, *row, *column;
    for (int64_t i = 1; i < 6; i++)
        powers[i] = dt * powers[i - 1];
    for (int64_t i = 0; i < order; i++)
        for (int64_t k = i + 1; k <= order; k++)
            for (int c = 0; c < 3; c++)
                x[3 * i + c] += factor[k - i] * x[3 * k + c];
    for (int64_t i = 0; i < order; i++) /* rows of F P: row i needs rows below it, which are still old */
        for (int64_t k = i + 1; k <= order; k++)
            for (int c = 0; c < 3; c++)
                for (int64_t j = 0; j < s; j++) {
                    row = P + (3 * i + c) * s;
                    row[j] += factor[k - i] * P[(3 * k + c) * s + j];
                }
    for (int64_t i = 0; i < order; i++) /* columns of (F P) F' */
        for (int64_t k = i + 1; k <= order; k++)
            for (int c = 0; c < 3; c++)
                for (int64_t j = 0; j < s; j++) {
                    column = P + j * s + 3 * i + c;
                    *column += factor[k - i] * P[j * s + 3 * k + c];
                }
    for (int64_t i = 0; i <= order; i++)
        for (int64_t j = 0; j <= order; j++) {
            int64_t left = order - i, right = order - j, power = left + right + 1;
            double noise = q * weight[left] * weight[right] / (double)power * powers[power];
            for (int c = 0; c < 3; c++)
                P[(3 * i + c) * s + 3 * j + c] += noise;
        }
}

/* innovation nu and inverse of its covariance; returns the normalised innovation squared */
static double innovation(double *nu, double *inverted, const double *x, const double *P, const double *row, int64_t s)
{
    double S[9], squared = 0.0;
    for (int i = 0; i < 3; i++) {
        nu[i] = row[i] - x[i];
        for (int j = 0; j < 3; j++)
            S[3 * i + j] = P[i * s + j] + row[3 + 3 * i + j];
    }
    inverse(inverted, S);
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++)
            squared += nu[i] * inverted[3 * i + j] * nu[j];
    return squared;
}

/* x + K nu, and (I - K H) P (I - K H)' + K R K' = B - (B H' - K R) K' with B = P - K H P */
static void correct(double *x, double *P, const double *row, int64_t s)
{
    double nu[3], inverted[9], K[MAX_STATE * 3], top[3 * MAX_STATE], rest[3];
    const double *R = row + 3;
    innovation(nu, inverted, x, P, row, s);
    memcpy(top, P, sizeof(double) * 3 * (size_t)s);
    for (int64_t i = 0; i < s; i++)
        for (int j = 0; j < 3; j++)
            K[3 * i + j] = P[i * s] * inverted[j] + P[i * s + 1] * inverted[3 + j] + P[i * s + 2] * inverted[6 + j];
    for (int64_t i = 0; i < s; i++) {
        const double *k = K + 3 * i;
        x[i] += k[0] * nu[0] + k[1] * nu[1] + k[2] * nu[2];
        for (int64_t j = 0; j < s; j++)
            P[i * s + j] -= k[0] * top[j] + k[1] * top[s + j] + k[2] * top[2 * s + j];
        for (int j = 0; j < 3; j++)
            rest[j] = P[i * s + j] - (k[0] * R[j] + k[1] * R[3 + j] + k[2] * R[6 + j]);
        for (int64_t j = 0; j < s; j++)
            P[i * s + j] -= rest[0] * K[3 * j] + rest[1] * K[3 * j + 1] + rest[2] * K[3 * j + 2];
    }
}

/* Two detections of one obstacle? */
static int doubled(const double *rows, int64_t m, double gate)
{
    for (int64_t j = 0; j < m; j++)
        for (int64_t k = 0; k < j; k++) {
            const double *a = rows + ROW * j, *b = rows + ROW * k;
            double squared = 0.0;
            for (int c = 0; c < 3; c++)
                squared += (a[c] - b[c]) * (a[c] - b[c]);
            if (squared <= gate * (trace(a + 3, 3) + trace(b + 3, 3)))
                return 1;
        }
    return 0;
}

/* Give each track its detection, or -1; returns how many have one, or -1 when more than one assignment is possible. */
static int64_t assign(Tracks *t, int64_t n, int64_t m, int64_t s, const double *rows, double gate)
{
    double nu[3], inverted[9];
    int64_t found = 0;
    for (int64_t j = 0; j < m; j++)
        t->owners[j] = -1;
    for (int confirmed = 1; confirmed >= 0; confirmed--) /* confirmed tracks choose before the others */
        for (int64_t i = 0; i < n; i++) {
            const double *x = t->x + s * i, *P = t->P + s * s * i;
            if ((t->ids[i] != UNCONFIRMED) != confirmed)
                continue;
            t->detections[i] = -1;
            for (int64_t j = 0; j < m; j++) {
                const double *row = rows + ROW * j;
                double squared = 0.0;
                if (!confirmed && t->owners[j] >= 0 && t->ids[t->owners[j]] != UNCONFIRMED)
                    continue;
                for (int c = 0; c < 3; c++)
                    squared += (row[c] - x[c]) * (row[c] - x[c]);
                if (squared > gate * (trace(P, s) + trace(row + 3, 3)))
                    continue;
                double distance = innovation(nu, inverted, x, P, row, s);
                if (!(distance <= gate))
                    continue;
                if (t->detections[i] >= 0 || t->owners[j] >= 0)
                    return -1;
                t->detections[i] = j;
                t->owners[j] = i;
                t->distances[i] = distance;
                found++;
            }
        }
    return found;
}

static void cap(double *v, double most)
{
    double squared = v[0] * v[0] + v[1] * v[1] + v[2] * v[2];
    if (squared > most * most)
        for (int c = 0; c < 3; c++)
            v[c] *= most / sqrt(squared);
}

/* Take over what else the detections say, when every track has one; returns flags. */
static int64_t take_over(Tracks *t, int64_t n, const double *rows, double stamp, int64_t mask)
{
    int64_t flags = ALL_SEEN | IN_ORDER;
    for (int64_t i = 0; i < n; i++) {
        const double *row = rows + ROW * t->detections[i];
        double weight = (double)(++t->counts[i] < FULL_COUNT ? t->counts[i] : FULL_COUNT);
        t->hits[i] = (t->hits[i] << 1 & mask) | 1;
        t->ages[i]++;
        t->last_seen[i] = stamp;
        for (int c = 0; c < 3; c++)
            t->sizes[3 * i + c] += (row[12 + c] - t->sizes[3 * i + c]) / weight;
        memcpy(t->quaternions + 4 * i, row + 15, 4 * sizeof(double));
        if (t->detections[i] != i)
            flags &= ~IN_ORDER;
    }
    return flags;
}

/* Update n tracks with m detections (m, ROW). Returns flags, or -1 when the assignment is not obvious: then the new
 * block is void. Without the flag ALL_SEEN, only states, covariances, distances and detections are new.
 *
 * mask: the bits of hits that are kept. before, after: blocks of the tracks. */
int64_t track_update(int64_t n, int64_t m, int64_t s, int64_t mask, double stamp, double dt, double q, double gate,
                     double max_speed, const double *before, const double *rows, double *after)
{
    Tracks t = tracks_at(after, n, s);
    int all_confirmed = 1;
    if (s > MAX_STATE || dt < 0.0 || doubled(rows, m, gate))
        return -1;
    memcpy(after, before, (size_t)((double *)t.distances - after) * sizeof *after);
    for (int64_t i = 0; i < n; i++)
        predict(t.x + s * i, t.P + s * s * i, dt, q, s);
    int64_t found = assign(&t, n, m, s, rows, gate);
    if (found < 0)
        return -1;
    for (int64_t i = 0; i < n; i++) {
        all_confirmed = all_confirmed && t.ids[i] != UNCONFIRMED;
        if (t.detections[i] < 0)
            continue;
        correct(t.x + s * i, t.P + s * s * i, rows + ROW * t.detections[i], s);
        cap(t.x + s * i + 3, max_speed);
    }
    return all_confirmed && found == n && n == m ? take_over(&t, n, rows, stamp, mask) : 0;
}

/* Copy track k of a block to track i of another one. */
static void copy_track(Tracks *to, int64_t i, const Tracks *from, int64_t k, int64_t s)
{
    memcpy(to->x + s * i, from->x + s * k, (size_t)s * sizeof(double));
    memcpy(to->P + s * s * i, from->P + s * s * k, (size_t)(s * s) * sizeof(double));
    memcpy(to->sizes + 3 * i, from->sizes + 3 * k, 3 * sizeof(double));
    memcpy(to->quaternions + 4 * i, from->quaternions + 4 * k, 4 * sizeof(double));
    to->last_seen[i] = from->last_seen[k];
    to->hits[i] = from->hits[k];
    to->ages[i] = from->ages[k];
    to->counts[i] = from->counts[k];
    to->ids[i] = from->ids[k];
}

/* Set track i to its first detection; variances: of the components of velocity and acceleration. */
static void begin_track(Tracks *t, int64_t i, int64_t s, const double *row, double stamp, const double *variances)
{
    double *x = t->x + s * i, *P = t->P + s * s * i;
    memset(x, 0, (size_t)s * sizeof *x);
    memset(P, 0, (size_t)(s * s) * sizeof *P);
    for (int64_t r = 0; r < s; r++)
        P[s * r + r] = r < 3 ? 0.0 : variances[r / 3 - 1];
    for (int r = 0; r < 3; r++) {
        x[r] = row[r];
        memcpy(P + s * r, row + 3 + 3 * r, 3 * sizeof *P);
    }
    memcpy(t->sizes + 3 * i, row + 12, 3 * sizeof *row);
    memcpy(t->quaternions + 4 * i, row + 15, 4 * sizeof *row);
    t->last_seen[i] = stamp;
    t->hits[i] = t->ages[i] = t->counts[i] = 1;
    t->ids[i] = UNCONFIRMED;
}

static int64_t number_of_bits(int64_t word)
{
    int64_t n = 0;
    for (; word; word &= word - 1)
        n++;
    return n;
}

/* Take over what the detections of an update say, end tracks, begin tracks, and confirm tracks.
 *
 * block: n tracks after track_update without the flag ALL_SEEN; changed (n): 1 where the kind of shape has changed.
 * needed, window: hits and updates after which a track is confirmed. variances: as in begin_track. Out: at most
 * n + m tracks, where `detections` has the index of each track before, or n + j for detection j. Returns their
 * number. */
int64_t track_renew(int64_t n, int64_t m, int64_t s, int64_t needed, int64_t window, int64_t next_id, double stamp,
                    double max_unseen, const double *variances, const double *rows, const int8_t *changed, double *block,
                    double *out)
{
    Tracks t = tracks_at(block, n, s), to;
    int64_t kept = 0, mask = ((int64_t)1 << window) - 1, born = m;
    for (int64_t i = 0; i < n; i++) {
        t.hits[i] = t.hits[i] << 1 & mask;
        t.ages[i]++;
        if (t.detections[i] >= 0) {
            const double *row = rows + ROW * t.detections[i];
            double weight = (double)(t.counts[i] = changed[i] ? 1 : t.counts[i] + 1);
            weight = weight < FULL_COUNT ? weight : FULL_COUNT;
            t.hits[i] |= 1;
            t.last_seen[i] = stamp;
            for (int c = 0; c < 3; c++)
                t.sizes[3 * i + c] += (row[12 + c] - t.sizes[3 * i + c]) / weight;
            memcpy(t.quaternions + 4 * i, row + 15, 4 * sizeof *row);
            born--;
        }
        int alive = stamp - t.last_seen[i] <= max_unseen + 1e-9;
        alive = alive && (t.ids[i] != UNCONFIRMED || t.ages[i] < window || number_of_bits(t.hits[i]) >= needed);
        kept += alive;
        t.distances[i] = alive ? 1.0 : 0.0; /* no longer needed here */
    }
    to = tracks_at(out, kept + born, s);
    kept = 0;
    for (int64_t i = 0; i < n + m; i++) {
        if (i < n ? t.distances[i] == 0.0 : t.owners[i - n] >= 0)
            continue;
        if (i < n)
            copy_track(&to, kept, &t, i, s);
        else
            begin_track(&to, kept, s, rows + ROW * (i - n), stamp, variances);
        if (to.ids[kept] == UNCONFIRMED && number_of_bits(to.hits[kept]) >= needed)
            to.ids[kept] = next_id++;
        to.detections[kept++] = i;
    }
    return kept;
}

/* The obstacles of all tracks, dt later, where dt >= 0; they do not rotate.
 *
 * shapes: the same obstacles at any time, with other sizes. Out: the structure Obstacles; positions, velocities and
 * angular velocities (n, 3); covariances (n, 3, 3); times at which they were seen (n); sizes (n, 3); radii (n); the
 * square of the largest speed (1). Other arrays are those of the shapes, or of the block. Returns whether a size is not
 * that of the shapes. */
int64_t track_obstacles(int64_t n, int64_t s, double dt, double q, double *block, const Obstacles *shapes, double *out)
{
    Tracks t = tracks_at(block, n, s);
    Obstacles *placed = (Obstacles *)out;
    double *positions = out + sizeof(Obstacles) / sizeof(double), *velocities = positions + 3 * n;
    double *rates = velocities + 3 * n, *covariances = rates + 3 * n, *stamps = covariances + 9 * n;
    double *sizes = stamps + n, *radii = sizes + 3 * n;
    double x[MAX_STATE], P[MAX_STATE * MAX_STATE], fastest = 0.0;
    int resized = 0;
    for (int64_t i = 0; i < n; i++) {
        memcpy(x, t.x + s * i, (size_t)s * sizeof *x);
        memcpy(P, t.P + s * s * i, (size_t)(s * s) * sizeof *P);
        predict(x, P, dt, q, s);
        memcpy(positions + 3 * i, x, 3 * sizeof *x);
        memcpy(velocities + 3 * i, x + 3, 3 * sizeof *x);
        for (int r = 0; r < 3; r++) {
            rates[3 * i + r] = 0.0;
            memcpy(covariances + 9 * i + 3 * r, P + s * r, 3 * sizeof *P);
        }
        stamps[i] = t.last_seen[i];
        const double *size = shapes->hulls[i] ? shapes->sizes + 3 * i : t.sizes + 3 * i;
        for (int c = 0; c < 3; c++) {
            sizes[3 * i + c] = size[c];
            resized = resized || size[c] != shapes->sizes[3 * i + c];
        }
        radii[i] = shapes->hulls[i] ? shapes->radii[i] : bounding_radius(shapes->kinds[i], size);
        fastest = fmax(fastest, x[3] * x[3] + x[4] * x[4] + x[5] * x[5]);
    }
    *placed = *shapes;
    placed->positions = positions;
    placed->quaternions = t.quaternions;
    placed->velocities = velocities;
    placed->rates = rates;
    placed->covariances = covariances;
    placed->stamps = stamps;
    placed->sizes = sizes;
    placed->radii = radii;
    radii[n] = fastest;
    return resized;
}
