#include "cpu/cell_sort.h"
#include "cpu/chunk.h"
#include "cpu/parallel.h"
#include "grid/activate_workspace.cpu.h"
#include "grid/cell_order.h"
#include "grid/status.h"

// Finds the active blocks, numbers them in the order of the table, groups the particles by base block with a stable
// counting sort, and writes the schedule. Every result is the same for any number of threads. The cost follows the
// particles: only tiles of the table with active blocks are read.
namespace mpm::cpu {
inline namespace TORCH_MPM_ISA {

using W = ActivateWorkspace;

constexpr int64_t kWorthThreads = 8192;  // number of particles or slots below which threads do not pay

// Calls f(part, begin, end) for `parts` nearly equal parts of [0, count), in parallel.
template <class F>
void for_parts(int parts, int64_t count, const F& f) {
  parallel_ranges(parts, count < kWorthThreads ? parts : 1, [&](int64_t first, int64_t last) {
    for (int64_t part = first; part < last; part++) f(int(part), count * part / parts, count * (part + 1) / parts);
  });
}

// Blocks touched from a base block whose particle has its base node at `local` inside it: bit o for the neighbour that
// lies one block further along the axes of o, the last axis being bit 0 of o.
template <int Order, int D>
MPM_HD unsigned touched_blocks(const int local[D]) {
  unsigned blocks = 1;
  MPM_UNROLL for (int i = D - 1, bit = 1; i >= 0; i--, bit *= 2)
    if (local[i] + Order >= kBlockWidth) blocks |= blocks << bit;
  return blocks;
}

template <class T, int D>
struct Activation {
  const ActivateArguments<T, D>& a;
  W w;
  ScheduleOut schedule;
  int64_t table_size;
  int64_t neighbour[kColours<D>];  // distance of neighbour o in the table

  explicit Activation(const ActivateArguments<T, D>& arguments)
      : a(arguments),
        w(activate_layout(a, static_cast<char*>(a.workspace))),
        table_size(int64_t(a.scenes) * a.geometry.blocks_per_scene) {
    lay_out<D>(schedule, a.schedule, a.slots(), a.particles);
    for (int o = 0; o < kColours<D>; o++) {
      neighbour[o] = 0;
      for (int i = 0; i < D; i++) neighbour[o] = neighbour[o] * a.geometry.blocks[i] + (o >> (D - 1 - i) & 1);
    }
  }

  int64_t* totals(int slice) const { return w.totals + slice * W::kTotals; }
  int* count(int slice) const { return w.count + int64_t(slice) * a.max_blocks; }

  // visit(first particle, particles) for the runs of a slice.
  template <class F>
  void for_runs(int slice, int64_t begin, int64_t end, const F& visit) const {
    const int64_t runs = totals(slice)[W::kRuns];
    for (int64_t r = 0; r < runs; r++) {
      const int first = w.run[begin + r];
      visit(first, (r + 1 < runs ? w.run[begin + r + 1] : int(end)) - first);
    }
  }

  // Replaces an entry of the totals by the sum over the slices before; returns the sum over all.
  int64_t scan(int which) const {
    int64_t s = 0;
    for (int k = 0; k < w.slices; k++) {
      const int64_t n = totals(k)[which];
      totals(k)[which] = s;
      s += n;
    }
    return s;
  }
};

enum class Location { inside, outside, not_finite };

// Scene and base node of one particle, and whether it is skipped for its position or its scene.
template <int Order, class T, int D>
Location place_of(const ActivateArguments<T, D>& a, int64_t p, int& scene, int base[D]) {
  T x[D], f[D];
  scene = a.scene ? a.scene[p * a.scene_stride] : 0;
  for (int i = 0; i < D; i++) x[i] = at(a.x, p, i);
  if (!is_finite<D>(x)) return Location::not_finite;
  const bool inside = locate<Order>(a.geometry, x, base, f) && scene >= 0 && scene < a.scenes;
  return inside ? Location::inside : Location::outside;
}

// Base block and cell of one particle.
template <int Order, class T, int D>
void classify(const Activation<T, D>& s, int64_t p) {
  const ActivateArguments<T, D>& a = s.a;
  int scene, base[D], block[D];
  if (place_of<Order>(a, p, scene, base) != Location::inside) {
    s.w.key[p] = -1;
    return;
  }
  for (int i = 0; i < D; i++) block[i] = base[i] / kBlockWidth;
  s.w.key[p] = block_index(a.geometry, scene, block);
  s.w.cell[p] = uint8_t(node_in_block<D>(base));
}

// The same for kLanes particles at once; false, without a result, unless all are on the lattice.
template <int Order, class T, int D>
bool classify_pack(const Activation<T, D>& s, int64_t p) {
  const ActivateArguments<T, D>& a = s.a;
  using Values = typename RegisterOf<T, kLanes>::Value;
  using Integers = RegisterOf<float, kLanes>::Integer;
  using Unsigned = RegisterOf<float, kLanes>::Bits;
  typedef uint8_t Bytes __attribute__((vector_size(kLanes)));
  Unsigned key = {}, cell = {};
  bool known = true;
  if (a.scene)
    for (int l = 0; l < kLanes; l++) {
      key[l] = unsigned(a.scene[(p + l) * a.scene_stride]);
      known = known && key[l] < unsigned(a.scenes);
    }
  Mask<T, kLanes> inside;
  Group g = {};
  g.count = kLanes;
  g.consecutive = true;
  for (int l = 0; l < kLanes; l++) g.id[l] = int(p) + l;
  MPM_UNROLL for (int i = 0; i < D; i++) {
    const Lanes<T> base = base_node<Order>(a.geometry, i, load(a.x, g, i));
    const auto on = on_lattice<Order>(a.geometry, i, base);
    inside = i ? inside & on : on;
    Values node;
    __builtin_memcpy(&node, &base, sizeof(node));
    const Unsigned n = Unsigned(__builtin_convertvector(node, Integers));
    key = key * unsigned(a.geometry.blocks[i]) + n / kBlockWidth;
    cell = cell * kBlockWidth + n % kBlockWidth;
  }
  if (!known || !all(inside)) return false;
  const Bytes cells = __builtin_convertvector(cell, Bytes);
  __builtin_memcpy(s.w.key + p, &key, sizeof(key));
  __builtin_memcpy(s.w.cell + p, &cells, sizeof(cells));
  return true;
}

template <int Order, class T, int D>
void classify_slice(const Activation<T, D>& s, int64_t begin, int64_t end) {
  for (int64_t p = begin; p < end;) {
    if (p + kLanes <= end && classify_pack<Order>(s, p))
      p += kLanes;
    else
      for (const int64_t stop = p + kLanes < end ? p + kLanes : end; p < stop; p++) classify<Order>(s, p);
  }
}

// Calls visit(steps along the axes) for a block and its neighbours.
template <int D, class F>
void for_neighbours(const F& visit) {
  int step[3] = {};
  for (step[0] = -1; step[0] <= 1; step[0]++)
    for (step[1] = -1; step[1] <= 1; step[1]++)
      for (step[2] = D == 3 ? -1 : 0; step[2] <= (D == 3 ? 1 : 0); step[2]++) visit(step);
}

template <int Order, int D>
MPM_HD unsigned touched_blocks_of_cell(int cell) {
  int local[D];
  MPM_UNROLL for (int i = 0; i < D; i++)
    local[i] = cell_coordinate<D>(cell, i);
  return touched_blocks<Order, D>(local);
}

// Entries of the table before its active blocks are numbered: all bits are set by default; bit o is clear if particles
// of the block touch its neighbour o, and kActive if particles of another block touch this one.
constexpr int kActive = 1 << 8;

// The entry of a block with cleared bits.
template <class T, int D>
void mark_tile(const Activation<T, D>& s, int64_t entry) {
  __atomic_fetch_or(s.w.marked + entry / kTile / 64, 1ull << entry / kTile % 64, __ATOMIC_RELAXED);
}

// Consecutive particles mostly have the same base block: such runs are counted, and later placed, together. With
// `Marks` the blocks that they touch are marked in the table.
template <int Order, bool Marks, class T, int D>
void find_runs(const Activation<T, D>& s, int slice, int64_t begin, int64_t end) {
  uint8_t touched_of[kBlockNodes<D>];
  for (int cell = 0; cell < kBlockNodes<D>; cell++) touched_of[cell] = uint8_t(touched_blocks_of_cell<Order, D>(cell));
  int64_t dropped = 0, runs = 0;
  for (int64_t p = begin; p < end;) {
    s.w.run[begin + runs++] = int(p);
    const int key = s.w.key[p];
    const int64_t first = p;
    unsigned blocks = 0;
    for (; p < end && s.w.key[p] == key; p++) blocks |= key < 0 ? 0 : touched_of[s.w.cell[p]];
    if (key < 0) {
      dropped += p - first;
    } else if (Marks) {
      const int before = __atomic_load_n(s.a.table + key, __ATOMIC_RELAXED);
      if (!(before & int(blocks))) continue;
      if (before == -1) mark_tile(s, key);
      __atomic_fetch_and(s.a.table + key, ~int(blocks), __ATOMIC_RELAXED);
    }
  }
  s.totals(slice)[W::kDropped] = dropped;
  s.totals(slice)[W::kRuns] = runs;
}

// Clears the table entries of the previous activation: the blocks at the beginning of `block`.
template <class T, int D>
void clear_previous(const Activation<T, D>& s) {
  const ActivateArguments<T, D>& a = s.a;
  for (int64_t slot = 0; slot < a.slots() && a.block[slot] >= 0; slot++) a.table[a.block[slot]] = -1;
}

// Numbers the active blocks in the order of the table, and clears the marks of the tiles; returns the number of blocks.
// Particles touch no block before their own one, so an entry is complete when it is reached.
template <class T, int D>
int64_t number_blocks(const Activation<T, D>& s) {
  const ActivateArguments<T, D>& a = s.a;
  int64_t next = 0;
  const auto number = [&](int64_t b) {
    const unsigned known = unsigned(~a.table[b]);
    if (!known) return;
    for (int o = 1; o < kColours<D>; o++) {
      if (!(known >> o & 1)) continue;
      const int64_t other = b + s.neighbour[o];
      if (a.table[other] == -1) mark_tile(s, other);
      a.table[other] &= ~kActive;
    }
    const bool given = next < a.max_blocks;
    a.table[b] = given ? int(next) : -1;
    if (given) a.block[next] = int(b);
    next++;
  };
  constexpr int kRow = 16;  // entries that are read together
  for (int64_t word = 0; word < s.w.words; word++)
    while (s.w.marked[word]) {
      const int64_t begin = (word * 64 + __builtin_ctzll(s.w.marked[word])) * kTile;
      const int64_t end = begin + kTile < s.table_size ? begin + kTile : s.table_size;
      for (int64_t b = begin; b < end; b += kRow) {
        const int count = end - b < kRow ? int(end - b) : kRow;
        int all = -1;
        if (count == kRow)
          for (int k = 0; k < kRow; k++) all &= a.table[b + k];
        if (count == kRow && all == -1) continue;
        for (int k = 0; k < count; k++) number(b + k);
      }
      s.w.marked[word] &= s.w.marked[word] - 1;
    }
  return next;
}

// Particles of each slot in a slice; the keys of runs become slots.
template <class T, int D>
void count_particles(const Activation<T, D>& s, int slice, int64_t begin, int64_t end, int64_t slots) {
  int* count = s.count(slice);
  __builtin_memset(count, 0, sizeof(int) * slots);
  s.for_runs(slice, begin, end, [&](int first, int particles) {
    int& key = s.w.key[first];
    if (key < 0) return;
    key = s.a.table[key];
    count[key] += particles;
  });
}

// After an overflow: particles that touch a block without a slot are not transferred.
template <int Order, class T, int D>
void drop_particles_without_slot(const Activation<T, D>& s, int64_t begin, int64_t end) {
  for (int64_t p = begin; p < end; p++) {
    const int key = s.w.key[p];
    if (key < 0) continue;
    const unsigned touched = touched_blocks_of_cell<Order, D>(s.w.cell[p]);
    for (int o = 0; o < kColours<D>; o++)
      if ((touched >> o & 1) && s.a.table[key + s.neighbour[o]] < 0) s.w.key[p] = -1;
  }
}

// Offsets of each slot, and where each slice puts its particles. Returns the number of particles transferred.
template <class T, int D>
int64_t place_slots(const Activation<T, D>& s, int64_t slots) {
  const ActivateArguments<T, D>& a = s.a;
  for_parts(s.w.slices, slots, [&](int slice, int64_t begin, int64_t end) {
    int64_t particles = 0;
    for (int64_t slot = begin; slot < end; slot++)
      for (int k = 0; k < s.w.slices; k++) particles += s.count(k)[slot];
    s.totals(slice)[W::kParticles] = particles;
  });
  const int64_t transferred = s.scan(W::kParticles);
  for_parts(s.w.slices, slots, [&](int slice, int64_t begin, int64_t end) {
    int next = int(s.totals(slice)[W::kParticles]);
    for (int64_t slot = begin; slot < end; slot++) {
      a.offsets[slot] = next;
      for (int k = 0; k < s.w.slices; k++) {
        int& count = s.count(k)[slot];
        const int n = count;
        count = next;
        next += n;
      }
    }
  });
  for (int64_t slot = slots; slot < a.slots(); slot++) a.block[slot] = -1;
  for (int64_t slot = slots; slot <= a.slots(); slot++) a.offsets[slot] = int(transferred);
  return transferred;
}

// Writes the index; `outside` is where the slice puts the particles that are not transferred.
template <class T, int D>
void fill_index(const Activation<T, D>& s, int slice, int64_t begin, int64_t end, int64_t outside) {
  int* next = s.count(slice);
  s.for_runs(slice, begin, end, [&](int first, int count) {
    const int slot = s.w.key[first];
    const int64_t place = slot < 0 ? outside : next[slot];
    int* index = s.a.index + place;
    for (int i = 0; i < count; i++) index[i] = first + i;
    if (slot < 0) {
      outside += count;
    } else {
      __builtin_memcpy(s.w.cell_at + place, s.w.cell + first, count);
      next[slot] += count;
    }
  });
}

// Lists the base blocks by colour and the chunks of each; returns the number of chunks.
template <class T, int D>
int64_t list_base_blocks(const Activation<T, D>& s, int64_t slots) {
  const ActivateArguments<T, D>& a = s.a;
  const ScheduleOut& out = s.schedule;
  const auto colour_of = [&](int64_t slot) { return block_colour(a.geometry, a.block[slot]); };
  int next[kColours<D>] = {};
  for (int64_t slot = 0; slot < slots; slot++)
    if (a.offsets[slot + 1] > a.offsets[slot]) next[colour_of(slot)]++;
  int base_blocks = 0;
  for (int c = 0; c < kColours<D>; c++) {
    const int n = next[c];
    out.colour_start[c] = next[c] = base_blocks;
    base_blocks += n;
  }
  out.colour_start[kColours<D>] = base_blocks;
  for (int64_t slot = 0; slot < slots; slot++)
    if (a.offsets[slot + 1] > a.offsets[slot]) out.base_slot[next[colour_of(slot)]++] = int(slot);
  int chunks = 0;
  for (int b = 0; b < base_blocks; b++) {
    const int slot = out.base_slot[b];
    out.base_chunk[b] = chunks;
    for (int begin = a.offsets[slot]; begin < a.offsets[slot + 1]; begin += kChunk) {
      out.chunk_slot[chunks] = slot;
      out.chunk_begin[chunks++] = begin;
    }
  }
  out.base_chunk[base_blocks] = chunks;
  return chunks;
}

// Order of a chunk's particles by cell. Returns the number of particles that do not follow their predecessor in memory.
template <class T, int D>
int sort_chunk(const Activation<T, D>& s, int64_t chunk) {
  const int begin = s.schedule.chunk_begin[chunk], slot_end = s.a.offsets[s.schedule.chunk_slot[chunk] + 1];
  const int count = slot_end - begin < kChunk ? slot_end - begin : kChunk;
  const uint8_t* cell = s.w.cell_at + begin;
  const int* id = s.a.index + begin;
  uint16_t* order = s.schedule.order + begin;
  uint16_t* end = s.schedule.cell_end + chunk * kBlockNodes<D>;
  uint16_t nth[kChunk];
  const bool falls = sort_by_cell<kBlockNodes<D>>(cell, count, nth, end);
  for (int i = 0; i < count; i++) order[i] = uint16_t(cell[i] * kChunk + nth[i]);
  const bool sorted = !falls && id[count - 1] - id[0] == count - 1;
  s.schedule.chunk_sorted[chunk] = sorted;
  int breaks = 0;
  if (!sorted)
    for (int i = 1; i < count; i++) breaks += id[nth[i]] != id[nth[i - 1]] + 1;
  return breaks;
}

// Assigns slots to blocks that particles may touch before the next activation: all neighbours of base blocks. Returns
// the number of slots with blocks; reports in `next_drift` if there is no room for all of them.
template <class T, int D>
int64_t add_margin(const Activation<T, D>& s, int64_t slots) {
  const ActivateArguments<T, D>& a = s.a;
  int64_t next = slots;
  bool all = true;
  for (int64_t slot = 0; slot < slots; slot++) {
    if (a.offsets[slot] == a.offsets[slot + 1]) continue;
    int block[D];
    const int scene = block_coordinates(a.geometry, a.block[slot], block);
    for_neighbours<D>([&](const int step[D]) {
      int other[D];
      for (int i = 0; i < D; i++) other[i] = block[i] + step[i];
      for (int i = 0; i < D; i++)
        if (other[i] < 0 || other[i] >= a.geometry.blocks[i]) return;
      int& entry = a.table[block_index(a.geometry, scene, other)];
      if (entry >= 0) return;
      if (next == a.slots()) {
        all = false;
        return;
      }
      a.block[next] = block_index(a.geometry, scene, other);
      entry = int(next++);
    });
  }
  if (!all) a.next_displacement->lost = Displacement::kLost;
  return next;
}

// Counts a skipped particle in a row of the status, unless an earlier activation has reported in the row. Returns
// whether it is the first one of the row.
bool report(int* row, int activation, Location place, int p) {
  if (row[kProblemActivation] >= 0 && row[kProblemActivation] != activation) return false;
  row[kProblemActivation] = activation;
  int* entry = row + (place == Location::outside ? kOutsideCount : kNonFiniteCount);
  if (entry[0]++ > 0 && entry[1] < p) return false;
  entry[1] = p;
  return true;
}

// Particles that are not transferred stand at the end of the index.
template <int Order, class T, int D>
void write_status(const Activation<T, D>& s, int64_t wanted, int64_t transferred) {
  const ActivateArguments<T, D>& a = s.a;
  int* status = a.status;
  for (int64_t row = 0; row <= a.scenes; row++)
    copy_status(a.previous_status ? a.previous_status + row * kStatusSize : nullptr, status + row * kStatusSize);
  const int activation = status[kActivations];
  for (int64_t i = transferred; i < a.particles; i++) {
    int scene, base[D];
    const Location place = place_of<Order>(a, a.index[i], scene, base);
    const int p = a.origin ? a.origin[a.index[i]] : a.index[i];
    if (place == Location::inside) continue;  // skipped because the grid is full
    if (scene == kAbsent) continue;
    report(status, activation, place, p);
    if (scene < 0 || scene >= a.scenes) continue;
    int* row = status + (1 + int64_t(scene)) * kStatusSize;
    if (report(row, activation, place, p))
      row[place == Location::outside ? kOutsideId : kNonFiniteId] = a.id ? int(a.id[p * a.id_stride]) : p;
  }
  if (wanted > a.max_blocks && status[kProblemActivation] < 0) status[kProblemActivation] = activation;
  status[kActivations]++;
  status[kBlocksNow] = int(wanted);
  if (wanted > status[kBlocksWanted]) status[kBlocksWanted] = int(wanted);
}

template <int Order, class T, int D>
void activate(const ActivateArguments<T, D>& a) {
  const Activation<T, D> s(a);
  if (a.fresh)  // the table has no blocks yet
    __builtin_memset(s.w.marked, 0, sizeof(uint64_t) * s.w.words);
  else
    clear_previous(s);
  for_parts(s.w.slices, a.particles, [&](int slice, int64_t begin, int64_t end) {
    classify_slice<Order>(s, begin, end);
    find_runs<Order, true>(s, slice, begin, end);
  });
  const int64_t wanted = number_blocks(s);
  const int64_t slots = wanted < a.max_blocks ? wanted : a.max_blocks;
  for_parts(s.w.slices, a.particles, [&](int slice, int64_t begin, int64_t end) {
    if (wanted > slots) {
      drop_particles_without_slot<Order>(s, begin, end);
      find_runs<Order, false>(s, slice, begin, end);
    }
    count_particles(s, slice, begin, end, slots);
  });
  const int64_t transferred = place_slots(s, slots);
  s.scan(W::kDropped);
  for_parts(s.w.slices, a.particles, [&](int slice, int64_t begin, int64_t end) {
    fill_index(s, slice, begin, end, transferred + s.totals(slice)[W::kDropped]);
  });
  const int64_t used = a.next_displacement ? add_margin(s, slots) : slots;
  if (a.used_slots) *a.used_slots = int(used);
  const int64_t chunks = list_base_blocks(s, slots);
  int64_t breaks = 0;
  parallel_ranges(chunks, 16, [&](int64_t begin, int64_t end) {
    int64_t found = 0;
    for (int64_t chunk = begin; chunk < end; chunk++) found += sort_chunk(s, chunk);
    __atomic_fetch_add(&breaks, found, __ATOMIC_RELAXED);
  });
  if (a.breaks) *a.breaks = breaks;
  write_status<Order>(s, wanted, transferred);
}

// The schedule has it already.
template <int Order, class T, int D>
void cell_order(const CellOrderArguments<T, D>& a) {
  const ScheduleIn s = schedule_of(a.topology);
  const int base_blocks = s.colour_start[kColours<D>];
  parallel_ranges(base_blocks ? s.base_chunk[base_blocks] : 0, 16, [&](int64_t begin, int64_t end) {
    for (int64_t c = begin; c < end; c++) {
      const Chunk chunk(a.topology, s, c);
      for (int i = 0; i < chunk.count; i++) a.order[s.chunk_begin[c] + i] = chunk.id[chunk.by_cell(i)];
    }
  });
  for (int64_t i = a.topology.offsets[a.topology.max_blocks]; i < a.topology.particles; i++)
    a.order[i] = a.topology.index[i];
}

template <class T, int D>
int64_t activate_workspace(const ActivateArguments<T, D>& a) {
  return activate_layout(a, nullptr).size;
}

MPM_INSTANTIATE_SIZE(activate_workspace, ActivateArguments)
MPM_INSTANTIATE_ORDERS(activate, ActivateArguments)
MPM_INSTANTIATE_ORDERS(cell_order, CellOrderArguments)

}  // namespace TORCH_MPM_ISA
}  // namespace mpm::cpu
