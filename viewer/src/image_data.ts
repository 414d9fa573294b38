/** Base64 images as URLs of blobs, which browsers decode once, wherever they stand. */

const urls = new Map<string, string>();

export function toBlobUrl(jpeg: string): string {
  let url = urls.get(jpeg);
  if (!url) {
    const bytes = Uint8Array.from(atob(jpeg), (sign) => sign.charCodeAt(0));
    url = URL.createObjectURL(new Blob([bytes], { type: "image/jpeg" }));
    urls.set(jpeg, url);
  }
  return url;
}
