// Decodes every message of an MCAP file with @mcap/core and protobufjs, and prints per topic: its schema, how many
// messages there are, and the sum of all numbers in them.
import { readFileSync } from "node:fs";

import { McapStreamReader } from "@mcap/core";
import { decompress } from "fzstd";
import protobuf from "protobufjs";
import descriptor from "protobufjs/ext/descriptor/index.js";

function total(value) {
  if (typeof value === "number") return Number.isFinite(value) ? value : 0;
  if (typeof value === "boolean") return value ? 1 : 0;
  if (Array.isArray(value)) return value.reduce((sum, inner) => sum + total(inner), 0);
  if (value !== null && typeof value === "object") return total(Object.values(value));
  return 0;
}

const reader = new McapStreamReader({ decompressHandlers: { zstd: (data) => decompress(data) } });
reader.append(new Uint8Array(readFileSync(process.argv[2])));
const schemas = new Map();
const channels = new Map();
const topics = {};
const attachments = [];
for (let record; (record = reader.nextRecord()); ) {
  if (record.type === "Schema" && !schemas.has(record.id)) {
    const root = protobuf.Root.fromDescriptor(descriptor.FileDescriptorSet.decode(record.data));
    schemas.set(record.id, { name: record.name, type: root.lookupType(record.name) });
  } else if (record.type === "Channel") {
    channels.set(record.id, record);
  } else if (record.type === "Attachment") {
    attachments.push(record.name);
  } else if (record.type === "Message") {
    const channel = channels.get(record.channelId);
    const { name, type } = schemas.get(channel.schemaId);
    const message = type.toObject(type.decode(record.data), { longs: String, bytes: String });
    topics[channel.topic] ??= { schema: name, messages: 0, sum: 0 };
    topics[channel.topic].messages += 1;
    topics[channel.topic].sum += total(message);
  }
}
if (!reader.done()) throw new Error("the file does not end as an MCAP file does");
process.stdout.write(JSON.stringify({ topics, attachments }));
