"""Sums over stamps: overlaps, products, projections, models and what is left of them."""

import numpy as np

from miricigale.photometry._core.sampling import convolve_batch
from miricigale.utils.compilation import njit


@njit()
def _sweep(box, grow, pairs):
    # boxes sorted by y0: candidates of i end where y0[j] passes i's last row
    n = box.shape[0]
    count = 0
    for i in range(n):
        # the box of stamp i, grown to both sides
        y1 = box[i, 0] + box[i, 2] + grow
        x0 = box[i, 1] - grow
        x1 = box[i, 1] + box[i, 3] + grow
        for j in range(i + 1, n):
            if box[j, 0] >= y1:
                break
            if box[j, 1] < x1 and box[j, 1] + box[j, 3] > x0 and box[j, 2] > 0 and box[i, 2] > 0:
                if pairs.shape[0] > 0:
                    pairs[count, 0] = i
                    pairs[count, 1] = j
                count += 1
    return count


def _listed(search):
    """Return the pairs that ``search(pairs)`` fills in; given an empty array it counts them only."""
    n_pairs = search(np.empty((0, 2), np.int32))
    pairs = np.empty((n_pairs, 2), np.int32)
    if n_pairs:
        search(pairs)
    return pairs


def find_pairs(box, grow):
    """
    List the pairs i < j, (n_pairs, 2), of boxes that overlap after one of them is grown by some pixels.

    Boxes, (n, 4), are (y0, x0, ny, nx), sorted by y0.
    """
    return _listed(lambda pairs: _sweep(box, grow, pairs))


@njit()
def _cross(box, other_box, tallest, pairs):
    # both sorted by y0: what ends above one of the others ends above all that follow
    count = 0
    low = 0
    for j in range(other_box.shape[0]):
        y0 = other_box[j, 0]
        x0 = other_box[j, 1]
        y1 = y0 + other_box[j, 2]
        x1 = x0 + other_box[j, 3]
        while low < box.shape[0] and box[low, 0] + tallest <= y0:
            low += 1
        if y1 == y0 or x1 == x0:
            continue
        for i in range(low, box.shape[0]):
            if box[i, 0] >= y1:
                break
            if (
                box[i, 0] + box[i, 2] > y0
                and box[i, 1] < x1
                and box[i, 1] + box[i, 3] > x0
                and box[i, 2] > 0
            ):
                if pairs.shape[0] > 0:
                    pairs[count, 0] = i
                    pairs[count, 1] = j
                count += 1
    return count


def cross_pairs(box, other_box):
    """
    List the pairs, (n_pairs, 2), of boxes of two sets that overlap.

    Boxes, (n, 4) and (m, 4), are (y0, x0, ny, nx), each set sorted by y0.
    """
    tallest = box[:, 2].max(initial=0)
    return _listed(lambda pairs: _cross(box, other_box, tallest, pairs))


# products of float32 add up in float64 without rounding, in whatever order
@njit(fastmath={"reassoc"})
def pair_products(a, a_box, a_start, b, b_box, b_start, pairs, out):
    """
    Sum products of two sets of flat stamps, with boxes and starts, over the pixels they share.

    ``pairs``, (n, 2), are rows of ``a`` and ``b``; ``out``, (n,), is filled with the sums.
    """
    for k in range(pairs.shape[0]):
        i = pairs[k, 0]
        j = pairs[k, 1]
        # the rectangle that the two stamps share
        y0 = max(a_box[i, 0], b_box[j, 0])
        y1 = min(a_box[i, 0] + a_box[i, 2], b_box[j, 0] + b_box[j, 2])
        x0 = max(a_box[i, 1], b_box[j, 1])
        x1 = min(a_box[i, 1] + a_box[i, 3], b_box[j, 1] + b_box[j, 3])
        total = 0.0
        for y in range(y0, y1):
            # places of the shared row in the flat stamps
            na = a_start[i] + (y - a_box[i, 0]) * a_box[i, 3] - a_box[i, 1] + x0
            nb = b_start[j] + (y - b_box[j, 0]) * b_box[j, 3] - b_box[j, 1] + x0
            row_a = a[na : na + x1 - x0]
            row_b = b[nb : nb + x1 - x0]
            part = 0.0
            for x in range(row_a.size):
                part += np.float64(row_a[x]) * np.float64(row_b[x])
            total += part
        out[k] = total


@njit(fastmath={"reassoc"})
def projections(values, box, start, image, out):
    """Sum each stamp times the image below it: ``out[k] = sum(stamp_k * image)``."""
    for k in range(box.shape[0]):
        n = start[k]
        nx = box[k, 3]
        total = 0.0
        for y in range(box[k, 0], box[k, 0] + box[k, 2]):
            row = values[n : n + nx]
            image_row = image[y, box[k, 1] : box[k, 1] + nx]
            part = 0.0
            for x in range(nx):
                part += np.float64(row[x]) * np.float64(image_row[x])
            total += part
            n += nx
        out[k] = total


@njit(fastmath={"reassoc"})
def whiten_stamps(values, box, start, inverse_sigma, out, sums):
    """
    Multiply each flat stamp by the inverse noise below it, (ny, nx), and sum it up.

    ``out`` is filled with the products; ``sums``, (n, 4), with the sums of the stamp, of the stamp where the
    inverse noise is not zero, of its squares, and of the squares of the products.
    """
    for k in range(box.shape[0]):
        n = start[k]
        nx = box[k, 3]
        light = 0.0
        usable_light = 0.0
        power = 0.0
        white_power = 0.0
        for y in range(box[k, 0], box[k, 0] + box[k, 2]):
            row = values[n : n + nx]
            weight = inverse_sigma[y, box[k, 1] : box[k, 1] + nx]
            white = out[n : n + nx]
            for x in range(nx):
                v = row[x]
                w = v * weight[x]
                white[x] = w
                light += v
                # no branch, for the sake of vector instructions
                usable_light += v if weight[x] > 0 else np.float32(0)
                power += np.float64(v) * np.float64(v)
                white_power += np.float64(w) * np.float64(w)
            n += nx
        sums[k, 0] = light
        sums[k, 1] = usable_light
        sums[k, 2] = power
        sums[k, 3] = white_power


@njit()
def scale_stamps(values, box, start, image):
    """Multiply stamps by an image in place; what they have beyond the image is zero."""
    for k in range(box.shape[0]):
        nx = box[k, 3]
        for y in range(box[k, 2]):
            n = start[k] + y * nx
            row = values[n : n + nx]
            if box[k, 0] + y < 0 or box[k, 0] + y >= image.shape[0]:
                row[:] = 0
                continue
            before = max(-box[k, 1], 0)
            end = min(nx, image.shape[1] - box[k, 1])
            row[:before] = 0
            row[max(end, before) :] = 0
            weight = image[box[k, 0] + y]
            for x in range(before, end):
                row[x] *= weight[box[k, 1] + x]


@njit()
def add_model(image, values, box, start, flux):
    """Add stamps times their fluxes to an image, in the order of the stamps."""
    for k in range(box.shape[0]):
        f = flux[k]
        if f == 0.0:
            continue
        n = start[k]
        for y in range(box[k, 0], box[k, 0] + box[k, 2]):
            for x in range(box[k, 1], box[k, 1] + box[k, 3]):
                image[y, x] += f * values[n]
                n += 1


@njit()
def residual_statistics(values, box, start, residual, light, inverse_sigma, out):
    """
    Sum the template-weighted mean of (residual / sigma)^2, and residual and light below the core.

    ``residual`` and ``light`` are images, (ny, nx). ``out`` has the shape (n, 4): mean square, sums of residual
    and light over pixels where the template exceeds a tenth of its peak, and the template's own sum there.
    """
    for k in range(box.shape[0]):
        peak = 0.0
        for n in range(start[k], start[k + 1]):
            peak = max(peak, values[n])
        n = start[k]
        nx = box[k, 3]
        square = 0.0
        weight = 0.0
        residual_sum = 0.0
        light_sum = 0.0
        core = 0.0
        for y in range(box[k, 0], box[k, 0] + box[k, 2]):
            row = values[n : n + nx]
            noise = inverse_sigma[y, box[k, 1] : box[k, 1] + nx]
            residual_row = residual[y, box[k, 1] : box[k, 1] + nx]
            light_row = light[y, box[k, 1] : box[k, 1] + nx]
            for x in range(nx):
                t = row[x]
                if t > 0.0 and noise[x] > 0.0:
                    r = residual_row[x]
                    # chi of the pixel, weighted by the template
                    z = r * noise[x]
                    square += t * z * z
                    weight += t
                    if t > 0.1 * peak:
                        residual_sum += r
                        light_sum += light_row[x]
                        core += t
            n += nx
        out[k, 0] = square / weight if weight > 0.0 else np.nan
        out[k, 1] = residual_sum
        out[k, 2] = light_sum
        out[k, 3] = core


@njit()
def offset_sums(values, box, start, flux, at, half, model, residual, inverse_sigma, out):
    """
    Sum up what the steps of sources against their stamps follow from.

    ``at``, (n, 2), are the sources' pixels (x, y), ``half`` is the window's half-width. ``out``, (n, 18), gets the
    products (4 x 4) of the weighted light, its derivatives by the steps along x and y, and the residual; light of
    others below the stamp, and the number of pixels: all zero for windows of less than 5 pixels.
    """
    term = np.empty(4)
    for k in range(box.shape[0]):
        y0, x0, ny, nx = box[k]
        first_row = max(at[k, 1] - half, y0)
        last_row = min(at[k, 1] + half + 1, y0 + ny)
        first_column = max(at[k, 0] - half, x0)
        last_column = min(at[k, 0] + half + 1, x0 + nx)
        sums = out[k]
        sums[:] = 0.0
        if min(last_row - first_row, last_column - first_column) < 5:
            continue
        # the part of the stamp in the window about the source
        stamp = values[start[k] : start[k] + ny * nx].reshape(ny, nx)
        stamp = stamp[first_row - y0 : last_row - y0, first_column - x0 : last_column - x0]
        for j in range(stamp.shape[0]):
            # at the window's edges one-sided differences
            j0 = max(j - 1, 0)
            j1 = min(j + 1, stamp.shape[0] - 1)
            for i in range(stamp.shape[1]):
                weight = np.float64(inverse_sigma[first_row + j, first_column + i])
                if weight == 0.0:
                    continue
                i0 = max(i - 1, 0)
                i1 = min(i + 1, stamp.shape[1] - 1)
                white = flux[k] * weight
                # whitened light, its derivatives by the steps, and the residual
                term[0] = white * stamp[j, i]
                term[1] = white * (np.float64(stamp[j, i0]) - stamp[j, i1]) / (i1 - i0)
                term[2] = white * (np.float64(stamp[j0, i]) - stamp[j1, i]) / (j1 - j0)
                term[3] = weight * residual[first_row + j, first_column + i]
                for a in range(4):
                    for b in range(4):
                        sums[4 * a + b] += term[a] * term[b]
                sums[16] += abs(
                    term[0] * (weight * model[first_row + j, first_column + i] - term[0])
                )
                sums[17] += 1.0


def convolve_stamps(values, box, start, rows, transfer, shape, out_box, out_start, out):
    """
    Convolve some of the flat stamps with a kernel given by its transform; the results are larger.

    ``rows``, (n,), tell which. ``transfer`` has the kernel's corner on the first pixel; ``shape`` is that of the
    transform, at least that of the largest result. Boxes of all results are grown by the kernel's
    half-width on each side, with their starts and the flat result.
    """
    batch = np.zeros((len(rows), *shape), values.dtype)
    for padded, k in zip(batch, rows, strict=True):
        ny, nx = box[k, 2:]
        padded[:ny, :nx] = values[start[k] : start[k + 1]].reshape(ny, nx)
    for convolved, k in zip(convolve_batch(batch, transfer, shape), rows, strict=True):
        ny, nx = out_box[k, 2:]
        out[out_start[k] : out_start[k + 1]] = convolved[:ny, :nx].ravel()
