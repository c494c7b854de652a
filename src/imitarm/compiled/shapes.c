/* Signed distances of all shapes: the formulas of imitarm.scene.rounded, edged and convex_hull, which are the reference. */

#include "shapes.h"

#include <math.h>
#include <string.h>

#define TINY 1e-9      /* [m] as in imitarm.scene.obstacle */
#define FLOOR 1e-12    /* of the shortest semi-axis, as in imitarm.scene.rounded */
#define ON_PLANE 1e-12 /* [m] as in imitarm.scene.convex_hull */
#define MAX_NEWTON 100
#define NEWTON_TOLERANCE 1e-7 /* of the last step; the remaining error is its square */

enum { SPHERE, BOX, CAPSULE, CYLINDER, CONE, ELLIPSOID, CONVEX_HULL, HALF_SPACE }; /* the order of KINDS */

static double dot(const double *a, const double *b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

static double limited(double x, double low, double high) { return x < low ? low : x > high ? high : x; }

static void rotation(double *to_local, const double *quaternion)
{
    double w = quaternion[0], x = quaternion[1], y = quaternion[2], z = quaternion[3];
    double rows[9] = {1 - 2 * (y * y + z * z), 2 * (x * y + w * z),     2 * (x * z - w * y),
                      2 * (x * y - w * z),     1 - 2 * (x * x + z * z), 2 * (y * z + w * x),
                      2 * (x * z + w * y),     2 * (y * z - w * x),     1 - 2 * (x * x + y * y)};
    memcpy(to_local, rows, sizeof rows);
}

/* the quaternion q after a rotation by the vector dt * rate */
static void turn(double *turned, const double *q, const double *rate, double dt)
{
    double half = 0.5 * dt * sqrt(dot(rate, rate));
    double factor = 0.5 * dt * (fabs(half) > 1e-8 ? sin(half) / half : 1.0);
    double w = cos(half), x = factor * rate[0], y = factor * rate[1], z = factor * rate[2];
    turned[0] = w * q[0] - x * q[1] - y * q[2] - z * q[3];
    turned[1] = w * q[1] + x * q[0] + y * q[3] - z * q[2];
    turned[2] = w * q[2] - x * q[3] + y * q[0] + z * q[1];
    turned[3] = w * q[3] + x * q[2] - y * q[1] + z * q[0];
}

void place(Solid *solid, const Obstacles *obstacles, int64_t i, double dt)
{
    const double *rate = obstacles->rates + 3 * i, *quaternion = obstacles->quaternions + 4 * i;
    double turned[4];
    solid->kind = obstacles->kinds[i];
    solid->radius = obstacles->radii[i];
    solid->hull = obstacles->hulls[i];
    memcpy(solid->size, obstacles->sizes + 3 * i, sizeof solid->size);
    for (int c = 0; c < 3; c++)
        solid->center[c] = obstacles->positions[3 * i + c] + dt * obstacles->velocities[3 * i + c];
    if (dt != 0.0 && (rate[0] != 0.0 || rate[1] != 0.0 || rate[2] != 0.0)) {
        turn(turned, quaternion, rate, dt);
        quaternion = turned;
    }
    rotation(solid->to_local, quaternion);
}

/* unit vector along q, or along x when q is too short; returns the length of q */
static double direction(double *normal, const double *q)
{
    double length = sqrt(dot(q, q));
    for (int c = 0; c < 3; c++)
        normal[c] = length < TINY ? (c == 0 ? 1.0 : 0.0) : q[c] / length;
    return length;
}

static double capsule(const double *q, double *normal, double radius, double half)
{
    double from_axis[3] = {q[0], q[1], q[2] - limited(q[2], -half, half)};
    return direction(normal, from_axis) - radius;
}

/* a box of n axes: a are the heights over its faces; returns the distance, and the outward normal in the same axes */
static double box(const double *a, double *out, int n)
{
    double largest = a[0], squares = 0.0;
    int axis = 0;
    for (int c = 0; c < n; c++) {
        out[c] = a[c] > 0.0 ? a[c] : 0.0;
        squares += out[c] * out[c];
        if (a[c] > largest) {
            largest = a[c];
            axis = c;
        }
    }
    double core = sqrt(squares);
    if (core >= TINY) {
        for (int c = 0; c < n; c++)
            out[c] /= core;
        return core;
    }
    out[axis] = 1.0;
    return core + (largest < 0.0 ? largest : 0.0);
}

static double cuboid(const double *q, double *normal, const double *size)
{
    double a[3];
    for (int c = 0; c < 3; c++)
        a[c] = fabs(q[c]) - 0.5 * size[c];
    double distance = box(a, normal, 3);
    for (int c = 0; c < 3; c++)
        normal[c] = copysign(normal[c], q[c]);
    return distance;
}

/* a normal (n_rho, n_z) in the half-plane of q, as a vector */
static void around_axis(double *normal, const double *q, double rho, double n_rho, double n_z)
{
    normal[0] = rho < TINY ? copysign(n_rho, q[0]) : q[0] * (n_rho / rho);
    normal[1] = rho < TINY ? 0.0 : q[1] * (n_rho / rho);
    normal[2] = n_z;
}

static double cylinder(const double *q, double *normal, double radius, double length)
{
    double rho = hypot(q[0], q[1]), out[2], a[2] = {rho - radius, fabs(q[2]) - 0.5 * length};
    double distance = box(a, out, 2);
    around_axis(normal, q, rho, out[0], copysign(out[1], q[2]));
    return distance;
}

static double cone(const double *q, double *normal, double radius, double height)
{
    double slant = hypot(radius, height), n_rho = height / slant, n_z = radius / slant;
    double rho = hypot(q[0], q[1]), out = rho - radius, up = q[2] + 0.5 * height;
    double over_side = n_rho * out + n_z * up;
    double along = limited(n_rho * up - n_z * out, 0.0, slant);
    double side_rho = out + n_z * along, side_z = up - n_rho * along;
    out = out > 0.0 ? out : 0.0;
    double to_side = sqrt(side_rho * side_rho + side_z * side_z), to_base = sqrt(out * out + up * up);
    double inside = over_side > -up ? over_side : -up, outside = to_side < to_base ? to_side : to_base;
    double normal_rho, normal_z;
    if (inside <= 0.0 || outside < TINY) {
        normal_rho = over_side >= -up ? n_rho : 0.0;
        normal_z = over_side >= -up ? n_z : -1.0;
    } else {
        normal_rho = (to_side <= to_base ? side_rho : out) / outside;
        normal_z = (to_side <= to_base ? side_z : up) / outside;
    }
    around_axis(normal, q, rho, normal_rho, normal_z);
    if (rho < TINY)
        normal[0] = normal_rho;
    return inside > 0.0 ? outside : inside;
}

static double ellipsoid(const double *q, double *normal, const double *axes)
{
    int shortest = axes[1] < axes[0] ? 1 : 0;
    shortest = axes[2] < axes[shortest] ? 2 : shortest;
    double least = axes[shortest], scaled[3], beyond[3], y[3], s = -INFINITY;
    for (int c = 0; c < 3; c++) {
        double floor = c == shortest ? FLOOR * least : 0.0;
        y[c] = fabs(q[c]) > floor ? fabs(q[c]) : floor;
        scaled[c] = axes[c] * y[c];
        beyond[c] = (axes[c] - least) * (axes[c] + least);
        s = scaled[c] - beyond[c] > s ? scaled[c] - beyond[c] : s;
    }
    for (int k = 0; k < MAX_NEWTON; k++) {
        double total = 0.0, slope = 0.0;
        for (int c = 0; c < 3; c++) {
            double shifted = s + beyond[c], term = scaled[c] / shifted;
            total += term * term;
            slope += term * term / shifted;
        }
        double step = (sqrt(total) - 1.0) * total / slope;
        s += step;
        if (step / s < NEWTON_TOLERANCE)
            break;
    }
    double foot[3], reach[3];
    for (int c = 0; c < 3; c++)
        foot[c] = y[c] / (s + beyond[c]);
    double length = sqrt(dot(foot, foot));
    for (int c = 0; c < 3; c++) {
        foot[c] /= length;
        reach[c] = axes[c] * foot[c];
        normal[c] = copysign(foot[c], q[c]);
    }
    return dot(foot, y) - sqrt(dot(reach, reach));
}

/* vector from the nearest point of any edge to q */
static void from_edges(double *away, const double *q, const Hull *hull)
{
    double best = INFINITY;
    int64_t e = hull->e;
    for (int64_t k = 0; k < e; k++) {
        double v[3], d[3] = {hull->directions[k], hull->directions[e + k], hull->directions[2 * e + k]};
        for (int c = 0; c < 3; c++)
            v[c] = q[c] - hull->starts[c * e + k];
        double along = limited(dot(v, d), 0.0, hull->lengths[k]);
        for (int c = 0; c < 3; c++)
            v[c] -= along * d[c];
        double squared = dot(v, v);
        if (squared < best) {
            best = squared;
            memcpy(away, v, sizeof v);
        }
    }
}

static double convex_hull(const double *q, double *normal, const Hull *hull)
{
    double distance = -INFINITY, above = -INFINITY, away[3];
    int64_t face = 0;
    for (int64_t k = 0; k < hull->m; k++) {
        double height = dot(q, hull->normals + 3 * k) - hull->offsets[k];
        if (height > distance) {
            distance = height;
            face = k;
        }
    }
    memcpy(normal, hull->normals + 3 * face, sizeof away);
    if (distance <= ON_PLANE)
        return distance;
    for (int64_t k = 0; k < hull->m; k++) { /* is the foot point on the face? */
        double height = dot(q, hull->normals + 3 * k) - hull->offsets[k] - distance * hull->cosines[face * hull->m + k];
        above = height > above ? height : above;
    }
    if (above <= ON_PLANE)
        return distance;
    from_edges(away, q, hull);
    distance = sqrt(dot(away, away));
    if (distance > TINY)
        direction(normal, away);
    return distance;
}

static double local_distance(const Solid *solid, const double *q, double *normal)
{
    const double *size = solid->size;
    switch (solid->kind) {
    case SPHERE:
        return direction(normal, q) - size[0];
    case BOX:
        return cuboid(q, normal, size);
    case CAPSULE:
        return capsule(q, normal, size[0], 0.5 * size[1]);
    case CYLINDER:
        return cylinder(q, normal, size[0], size[1]);
    case CONE:
        return cone(q, normal, size[0], size[1]);
    case ELLIPSOID:
        return ellipsoid(q, normal, size);
    case CONVEX_HULL:
        return convex_hull(q, normal, solid->hull);
    default: /* HALF_SPACE */
        normal[0] = normal[1] = 0.0;
        normal[2] = 1.0;
        return q[2];
    }
}

double bounding_radius(int kind, const double *size)
{
    switch (kind) {
    case BOX:
        return 0.5 * sqrt(dot(size, size));
    case CAPSULE:
        return size[0] + 0.5 * size[1];
    case CYLINDER:
    case CONE:
        return sqrt(size[0] * size[0] + 0.25 * size[1] * size[1]);
    case HALF_SPACE:
        return INFINITY;
    default:
        return fmax(size[0], fmax(size[1], size[2]));
    }
}

double signed_distance(const Solid *solid, const double *point, double *normal)
{
    const double *R = solid->to_local;
    double offset[3], q[3], local[3];
    for (int c = 0; c < 3; c++)
        offset[c] = point[c] - solid->center[c];
    if (solid->kind == SPHERE) {
        double distance = sqrt(dot(offset, offset));
        for (int c = 0; normal && c < 3 && distance > TINY; c++)
            normal[c] = offset[c] / distance;
        if (!normal || distance > TINY)
            return distance - solid->size[0];
    }
    for (int c = 0; c < 3; c++)
        q[c] = dot(R + 3 * c, offset);
    double distance = local_distance(solid, q, local);
    if (normal)
        for (int c = 0; c < 3; c++)
            normal[c] = R[c] * local[0] + R[3 + c] * local[1] + R[6 + c] * local[2];
    return distance;
}
